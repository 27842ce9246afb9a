"""An autofocus whose image weights come from a small trained network, beside the library's own.

    python scripts/learned_autofocus.py [--small] [--trials 12] [--out learned_autofocus]
    [--weights FOLDER]

The estimator repeats one step: it forms the image, weights its cells, transforms the weighted image
back to pulses, and takes the phase of each pulse relative to the result. It starts from SCA. It is
the method `learned` of `torchsar bench autofocus`, with the parameters that --weights writes. Two
further networks of the benchmark, `unrolled` and `lag_network`, are then trained on the same
scenes.

A phase that is added to a pulse is added to its estimate, whatever its size, and a constant or
linear phase over the pulses changes nothing. `entropy_fixed_point` and `autofocus` repeat the same
step with weights that follow from a formula. Here a network of 97 parameters computes the weight of
each cell from the power of the cell, of its surroundings, of its range cell and of the noise.

The network is trained on small simulated scenes of the config `isal_snr` and tested on scenes of
the full size of that config with other seeds. `torchsar.data.Simulated` makes both. All random
numbers are drawn by address, so that a second run prints the same losses.

In the same way, but with less effect, it learns the two thresholds (floors) of the stage
`EntropyFixedPoint`, by gradients through its iterations.

The script prints the loss during the training, its time, and the median over trials of the rms
phase error (rad) over SNR, with the Cramer-Rao bound for a scene of unknown amplitudes. The picture
shows these errors, and how far they exceed the bound. If the folder TORCHSAR_DATA (by default
shared/data beside the repository) holds recordings of aircraft, random phases are added to their
pulses, and the script prints how far the entropy of the image lies above that of the recording as
it is.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchsar import plot
from torchsar.compensate import (
    EntropyFixedPoint,
    autofocus,
    correct_pulse_phase,
    entropy_fixed_point,
    pga,
    pga_sca,
    sca,
)
from torchsar.core import Axis, Draws, Recording, Signal, Truth, cis, unit_level
from torchsar.data import Simulated
from torchsar.io import read_inverse
from torchsar.metrics import entropy, phase_rmse
from torchsar.metrics.bounds import pulse_phase_bound_of_scene_rad, pulse_phase_bound_rad, turntable_responses
from torchsar.study.bench.learned import LagAutofocus, LearnedAutofocus, UnrolledAutofocus, save_weights

CONFIG = "isal_snr"
TRAIN_SEED, TEST_SEED = 11, 12
DATA = Path(os.environ.get("TORCHSAR_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
RECORDINGS = ("isar_thz_airplane_even.npz", "isar_yak42_a.npz")
# training scenes, and smaller ones: pulses, range cells, length and width of the aircraft (m)
TRAINED, TINY = (128, 64, 0.08, 0.045), (64, 40, 0.04, 0.025)
LIBRARY = {f.__name__: f for f in (sca, pga, pga_sca, entropy_fixed_point, autofocus)}
X = "SNR (dB)"
Method = Callable[[Tensor], Tensor]


def sized(pulses: float, samples: float, length_m: float, width_m: float) -> list[str]:
    """Overrides of the config for scenes of another size."""
    plane = {"length_m": length_m, "width_m": width_m}
    return [f"world.pulses={pulses}", f"world.samples={samples}"] + [
        f"world.scene.aircraft.{name}={value}" for name, value in plane.items()
    ]


def scenes(trials: int, batch: int, size: Sequence[float]) -> Simulated:
    """Training scenes."""
    draws = Draws(TRAIN_SEED, trials=range(trials))
    return Simulated(CONFIG, draws, batch=batch, overrides=sized(*size), vary=any_snr)


def any_snr(draws: Draws) -> dict[str, Tensor]:
    """SNR and heading of training scenes."""
    return {
        "world.noise.snr_db": draws.uniform("snr", low=-10.0, high=20.0),
        "world.scene.aircraft.heading_deg": draws.uniform("heading", low=-10.0, high=10.0),
    }


Loss = Callable[[Tensor, Tensor, int], Tensor]


def train(parameters: Iterable[nn.Parameter], batches: Simulated, loss_of: Loss, rate: float) -> list[float]:
    """Loss of each step of Adam; a step takes one batch.

    Args:
        parameters: What is trained.
        batches: Data and true phases.
        loss_of: Loss of data (trial, pulse, range), phases (trial, pulse) and a drawn number.
        rate: Step size at the beginning; it falls to zero.
    """
    trained = list(parameters)
    adam = torch.optim.Adam(trained, lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, len(batches))
    drawn = Draws(batches.draws.seed).uniform("rounds before", (len(batches),), high=15.0)
    losses: list[float] = []
    for before, (recording, truth) in zip(drawn.long().tolist(), batches, strict=True):
        adam.zero_grad()
        loss = loss_of(recording.signal.data, truth.values["phase_rad"], before)
        loss.backward()
        nn.utils.clip_grad_norm_(trained, 1.0)
        adam.step()
        schedule.step()
        losses.append(float(loss.detach()))
    return losses


def phase_loss(phase: Tensor, truth: Tensor) -> Tensor:
    """Mean over trials of ln(1 - Strehl amplitude), which is about half the mean square error.

    The Strehl amplitude is the largest |mean over pulses of exp(j error)| of any linear phase:
    constant and linear phases are no errors. Differentiable.
    """
    error = cis((phase - truth).to(phase.dtype))
    amplitude = torch.fft.fft(error, 8 * error.shape[-1]).abs().amax(-1) / error.shape[-1]
    return (1 - amplitude + 1e-4).log().mean()


def loss_of_network(network: LearnedAutofocus, rounds: int = 3) -> Loss:
    """Mean loss of a few rounds. Others precede them without gradients, so that the network learns
    the first rounds and the last.
    """

    def loss(data: Tensor, truth: Tensor, before: int) -> Tensor:
        rows, total = unit_level(data).mT, torch.zeros(())
        with torch.no_grad():
            phase = network(data, before)
        for _ in range(rounds):
            phase = phase + network.step(rows, phase)
            total = total + phase_loss(phase, truth)
        return total / rounds

    return loss


def loss_of_phases(network: Method) -> Loss:
    """Loss of the phases that a network returns."""
    return lambda data, truth, _: phase_loss(network(data), truth)


def loss_of_stage(stage: EntropyFixedPoint, axes: tuple[Axis, ...]) -> Loss:
    """Loss of the phases that a stage estimates."""
    return lambda data, truth, _: phase_loss(stage(Signal(data, axes))["phase_rad"], truth)


def methods(network: LearnedAutofocus, floors: Sequence[float]) -> dict[str, Method]:
    """Estimators of the phase by name."""
    return {
        **{name: lambda data, function=function: function(data)["phase_rad"] for name, function in LIBRARY.items()},
        "entropy, learned floors": lambda data: entropy_fixed_point(data, floors=[(f, 12) for f in floors])[
            "phase_rad"
        ],
        "learned": network,
        "autofocus, started from learned": lambda data: autofocus(data, start=network(data))["phase_rad"],
    }


@torch.no_grad()
def errors(found: Mapping[str, Method], snr_db: Sequence[float], trials: int, size: Sequence[str]) -> dict[str, Tensor]:
    """Rms phase errors in rad by method, (SNR, trial), and their bound, (SNR, 1)."""
    table: dict[str, list[Tensor]] = {name: [] for name in ("bound", *found)}
    ratio = None
    for i, snr in enumerate(snr_db):
        draws = Draws(TEST_SEED, f"SNR {i}", range(trials))
        recording, truth = next(
            iter(Simulated(CONFIG, draws, batch=trials, overrides=[*size, f"world.noise.snr_db={snr}"]))
        )
        data = recording.signal.data
        ratio = ratio or bound_ratio(recording, truth)
        table["bound"].append(ratio * pulse_phase_bound_rad(10 ** (snr / 10), data.shape[-1])[None])
        for name, method in found.items():
            table[name].append(phase_rmse(method(data), truth.values["phase_rad"]))
    return {name: torch.stack(rows) for name, rows in table.items()}


def bound_ratio(recording: Recording, truth: Truth) -> float:
    """Bound for a scene of unknown amplitudes over that for a known scene.

    It hardly differs between scenes of one kind.
    """
    cross, down, amplitude = (truth.values[name][0] for name in ("cross_range_m", "range_m", "amplitude"))
    pulses, samples = recording.signal.data.shape[-2:]
    rate = float(truth.values["rotation_rad_s"])
    azimuth, response = turntable_responses(recording.radar, rate, cross, down, pulses, samples)
    power = float(((azimuth * amplitude) @ response).abs().square().mean())
    bound = pulse_phase_bound_of_scene_rad(azimuth, response, amplitude, 1.0)
    return float(bound / pulse_phase_bound_rad(power, samples))


@torch.no_grad()
def recorded(found: Mapping[str, Method], files: Sequence[Path]) -> dict[str, list[float]]:
    """Entropy of the image of recordings with added phases minus that without, in nats."""
    table: dict[str, list[float]] = {"no compensation": [], **{name: [] for name in found}}
    for path in files:
        data = read_inverse(path).signal.data[None]
        added = Draws(TEST_SEED).uniform("added", data.shape[:2], -math.pi, math.pi, torch.float32)
        turned = correct_pulse_phase(data, -added)
        estimates = {"no compensation": torch.zeros_like(added), **{name: f(turned) for name, f in found.items()}}
        for name, phase in estimates.items():
            table[name].append(image_entropy(correct_pulse_phase(turned, phase)) - image_entropy(data))
    return table


def image_entropy(data: Tensor) -> float:
    return float(entropy(torch.fft.fft(data, dim=-2)))


def show(title: str, heads: Sequence[str], rows: Mapping[str, Sequence[float]]) -> None:
    """Print a table."""
    print(f"{title:34}" + "".join(f"{head:>9}" for head in heads))
    for name, values in rows.items():
        print(f"{name:34}" + "".join(f"{value:9.3f}" for value in values))


def pictures(snr_db: Sequence[float], table: Mapping[str, Tensor]) -> list[Any]:
    """Errors over SNR, and their ratio to the bound for the methods that come near it."""
    bound = table["bound"]
    near = {name: table[name] / bound for name in ("entropy_fixed_point", "autofocus", "learned")}
    # these first, so that a method has one colour in both panels
    whole = {name: table[name] for name in (*near, *LIBRARY)}
    return [
        *plot.error_curves([panel("Phase error on unseen scenes", snr_db, whole, bound)], X, "rms (rad)", log_y=True),
        *plot.error_curves(
            [panel("Relative to the bound", snr_db, near, bound / bound)], X, "rms over bound", log_y=True
        ),
    ]


def panel(title: str, snr_db: Sequence[float], table: Mapping[str, Tensor], bound: Tensor) -> dict[str, Any]:
    """Medians over trials with their quartiles."""
    share = torch.tensor([0.5, 0.25, 0.75], dtype=torch.float64)
    levels = {name: plot.array(values.double().quantile(share, -1)) for name, values in table.items()}
    return {
        "title": title,
        "x": plot.array(torch.tensor(snr_db)),
        "series": {name: (level[0], level[1:].T) for name, level in levels.items()},
        "bounds": {"Cramer-Rao bound": plot.array(bound[:, 0])},
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--small", action="store_true", help="few steps and tests on small scenes, in seconds")
    parser.add_argument("--trials", type=int, help="test scenes at each SNR (default 12, or 3 with --small)")
    text = "folder for the parameters of all networks of the benchmark, of which two more are then trained"
    parser.add_argument("--weights", type=Path, help=text)
    parser.add_argument("--out", default="learned_autofocus", help="folder of the picture")
    options = parser.parse_args(arguments)
    steps, batch, size = (12, 4, TINY) if options.small else (240, 6, TRAINED)
    trials = options.trials or (3 if options.small else 12)
    snr_db = [0.0, 10.0] if options.small else [-10.0, -5.0, 0.0, 5.0, 10.0, 20.0]

    began = time.perf_counter()
    network = LearnedAutofocus(Draws(TRAIN_SEED))
    losses = train(network.parameters(), scenes(steps * batch, batch, size), loss_of_network(network), rate=0.03)
    for first in range(0, steps, steps // 6):
        part = losses[first : first + steps // 6]
        print(f"steps {first:3} to {first + len(part) - 1:3}: mean loss {sum(part) / len(part):.6f}")
    print(f"training: {steps} steps of {batch} scenes, {time.perf_counter() - began:.0f} s")

    if options.weights:
        options.weights.mkdir(parents=True, exist_ok=True)
        save_weights(network, options.weights / "learned.json")
        others = {"unrolled": UnrolledAutofocus(), "lag_network": LagAutofocus(Draws(TRAIN_SEED))}
        for name, other in others.items():
            began = time.perf_counter()
            losses = train(other.parameters(), scenes(steps * batch, batch, size), loss_of_phases(other), rate=0.02)
            save_weights(other, options.weights / f"{name}.json")
            part = losses[-(steps // 6) :]
            print(f"{name}: {time.perf_counter() - began:.0f} s, mean loss {sum(part) / len(part):.6f} at the end")

    stage = EntropyFixedPoint(nn.Parameter(torch.tensor([5.0, 2.0])))
    few = scenes(steps * batch // 8, batch, size)
    axes = next(iter(few))[0].signal.axes
    tuned = train(stage.parameters(), few, loss_of_stage(stage, axes), rate=0.1)
    learned = torch.as_tensor(stage.floors).tolist()
    print(f"floors of entropy_fixed_point: 5 and 2, learned {learned[0]:.2f} and {learned[1]:.2f}; {len(tuned)} steps")

    found = methods(network, learned)
    table = errors(found, snr_db, trials, sized(*TINY) if options.small else [])
    medians = {name: values.double().quantile(0.5, -1).tolist() for name, values in table.items()}
    show("median rms phase error (rad), SNR:", [f"{snr:g} dB" for snr in snr_db], medians)
    files = [DATA / name for name in RECORDINGS if (DATA / name).is_file()]
    if files and not options.small:
        show("recording: entropy above (nats)", [path.stem[5:13] for path in files], recorded(found, files))
    else:
        print("recordings: skipped")
    folder = Path(options.out)
    folder.mkdir(parents=True, exist_ok=True)
    plot.save(pictures(snr_db, table), folder / "learned_autofocus.png")


if __name__ == "__main__":
    main()
