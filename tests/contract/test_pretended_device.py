"""Stages, systems and metrics on a pretended accelerator, and on a real one where there is one: no
operation mixes devices, results equal those of the CPU, and the host does not wait more often for
more trials.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.contract.places import PLACES, Place
from tests.contract.pretended import DEVICE, Counts, pretended_device, to_device, to_host
from tests.study.scenes import CORRECT, SCENES, TILES, loaded_as, world
from tests.table.functions import FUNCTIONS, Entry, named, samples
from tests.table.numbers import NUMBERS
from tests.table.stages import CASES, Case, entering, raw, results
from torchsar.core import Axis, Draws, Signal
from torchsar.multichannel import detect
from torchsar.study.settings.sections import Loaded
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

# stages that cost seconds on the pretended device, and where else they or their parts run there
ELSEWHERE = {
    "alternate": "autofocus and rotation_coarse in turn",
    "autofocus": "in the chain of the system isal",
    "moving_point": "in the chain of the system geo",
    "rotation": "in the chain of the system isal_rotation",
    "rotation_evolution": "like rotation_genetic, with more steps",
}
# Readings and copies from the host of the recommended chain of a sweep, for two trials, and what
# makes it small enough for a test. A figure may only fall; then write the new one.
CHAIN_WAITS = {
    "stripmap_doppler": (4, []),
    "sal_snr": (5, []),
    "isal_snr": (15, []),
    "geo_velocity_scnr": (26, ["world.pulses=512"]),
    "isal_rotation_snr": (10, ["world.pulses=1000"]),  # the last step of a fit shows that it has converged
}

# sizes of worlds of SCENES that would take seconds
SMALL = {
    "isal_rotation": {"pulses": 400},
    "geo": {"pulses": 512},
    "geo_ocean": {"pulses": 300, "samples": 64},
    "path": {"pulses": 48, "samples": 48},
}
# the autofocus of this chain runs in that of isal, and link_phases, its costly part, above
CHAINS = {
    "path": {"recommended": {"stages": {"phase": {"stage": "pga"}, "correct": CORRECT, "image": TILES}}},
}
# these cost seconds a run: results only. The stages waited as often for four trials when written;
# scenes of geo_ocean are imaged one after another, and its waits hang on the targets in them
_ONCE = ("estimate_balance", "link_phases", "signal_intensity", "geo_ocean")
# Absolute differences of figures, in metres, m/s and dB: the iterations that find velocities of
# ships end at a thousandth of what noise leaves, and rounding sets where. Sums that round in
# another way change positions, which are 0.3 m off, by up to 1.4 mm. Fits of a rotation end up to a
# round later on an accelerator, which looks less often: a thousandth of a deviation, in percent.
LEEWAY = {"geo_ocean": 5e-3, "isal_rotation": 2e-4}


def waits(counts: Counts) -> Counter[str]:
    """What makes the host wait for the device: readings, and copies from pageable memory."""
    return counts.waits + counts.uploads


def compare(name: str, two: Counts, four: Counts) -> None:
    """Waits for four trials against those for two, and the table."""
    more = waits(four) - waits(two)
    growth = waits(four).total() - waits(two).total()
    # rounding may cost some iterations more, here or on another processor
    slack = max(1.0, 0.05 * waits(two).total())
    assert abs(growth) <= slack, f"{name}: {growth} more, at {dict(more.most_common(8))}"


@pytest.fixture(params=PLACES)
def place(request: pytest.FixtureRequest) -> Place:
    return PLACES[request.param]


def equal(place: Place, found: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    """A real device rounds differently, and what trials that are not ok hold may be anything."""
    ok = expected.get("ok", torch.tensor(True))
    for name, value in expected.items():
        there = place.take(found[name])
        if place.real and value.shape[: ok.ndim] == ok.shape:
            there, value = there[ok], value[ok]
        scale = 0.0 if value.dtype == torch.bool or not value.numel() else float(value.abs().nan_to_num().max())
        assert place.holds(found[name]), name
        torch.testing.assert_close(
            there,
            value,
            atol=max(tolerance, place.tolerance) * scale + (1e-18 if place.real else 0),
            rtol=0,
            equal_nan=True,
            msg=lambda m, n=name: f"{n}: {m}",
        )
    if place.real and "ok" in expected:
        assert place.take(found["ok"]).equal(ok)


def twice(x: Tensor) -> Tensor:
    return torch.cat([x, x]) if x.ndim else x


STAGES = [
    pytest.param(case, place, id=f"{name}-{case.name}")
    for name, place in PLACES.items()
    for case in CASES
    if place.real or case.name not in ELSEWHERE
]


@pytest.mark.slow
@pytest.mark.parametrize("case, place", STAGES)
def test_stages(case: Case, place: Place) -> None:
    """Two trials, and the same two twice."""
    signal = entering(case, raw(2, n_range=case.n_range))
    values = case.values(signal)
    expected = results(case.build()(signal, **values))
    every = []
    for repeated in (lambda x: x, twice)[: 1 if case.name in _ONCE else 2]:
        with place.counted() as counts:
            stage = case.build().to(place.device)
            given = place.put({name: repeated(value) for name, value in values.items()})
            found = results(stage(signal.with_data(place.put(repeated(signal.data))), **given))
        equal(place, found, {name: repeated(value) for name, value in expected.items()}, case.tolerance)
        every.append(counts)
    compare(case.name, every[0], every[-1])


HERE = [case for case in CASES if case.name not in ELSEWHERE]


@pytest.mark.slow
@pytest.mark.parametrize("case", HERE, ids=[case.name for case in HERE])
def test_nan_becomes_no_index(case: Case) -> None:
    """On a device a stage meets the NaN that its checks, which are read late, will refuse."""
    signal = entering(case, raw(2, n_range=case.n_range))
    values = case.values(signal)
    spoiled = [(_spoiled(signal.data), values)]
    spoiled += [(signal.data, {**values, key: _spoiled(x)}) for key, x in values.items() if x.is_floating_point()]
    for data, given in spoiled:
        with PLACES["pretended"].counted() as counts, suppress(ValueError):
            case.build().to(DEVICE)(signal.with_data(to_device(data)), **to_device(given))
        assert not counts.faults


def _spoiled(x: Tensor) -> Tensor:
    """With a NaN in the last trial."""
    bad = x.clone()
    bad[-1].view(-1)[0] = torch.nan
    return bad


def small(system: str, folder: Path) -> Loaded:
    processor = {**SCENES[system]["processor"], **CHAINS.get(system, {})}
    return loaded_as(folder, system, world=world(system, **SMALL.get(system, {})), processor=processor)


def figures(loaded: Loaded, device: str, trials: list[int]) -> dict[str, Tensor]:
    """Bounds and metrics of the recommended chain."""
    bench = Bench(loaded, device)
    batch = bench.batch(Draws(3, "run", trials), methods=["recommended"])
    bounds = {f"{key} {of}": x for key, each in bench.system.bounds(bench, batch).items() for of, x in each.items()}
    metrics = batch.outcomes["recommended"].metrics
    return {**bounds, **{key: x for key, x in metrics.items() if key != "seconds"}}


@pytest.mark.slow
@pytest.mark.parametrize("system", SCENES)
def test_systems(system: str, place: Place, tmp_path: Path) -> None:
    """Simulation, recommended chain, metrics and bounds, of few trials and of the same twice."""
    few = [0] if system in _ONCE else [0, 1]
    loaded = small(system, tmp_path)
    expected = figures(loaded, "cpu", few)
    every = []
    for trials in (few, few * 2)[: 1 if system in _ONCE else 2]:
        with place.counted() as counts:
            found = place.take(figures(loaded, str(place.device), trials))
        for name, value in expected.items():
            there = value if value.shape == found[name].shape else torch.cat([value] * (len(trials) // len(few)))
            torch.testing.assert_close(
                found[name],
                there,
                rtol=1e-2 if place.real else 1e-4,
                atol=1e-5 if place.real else LEEWAY.get(system, 1e-6),
                equal_nan=True,
                msg=lambda m, n=name: f"{n}: {m}",
            )
        every.append(counts)
    compare(system, every[0], every[-1])


@pytest.mark.slow
@pytest.mark.parametrize("system", SCENES)
def test_systems_work_where_a_device_is_the_default(system: str, place: Place, tmp_path: Path) -> None:
    loaded = small(system, tmp_path)
    with place.counted(), place.device:
        found = figures(loaded, str(place.device), [0])
    assert all(map(place.holds, found.values()))


@pytest.mark.slow
@pytest.mark.parametrize("sweep", CHAIN_WAITS)
@torch.no_grad()
def test_chains_wait_seldom(sweep: str) -> None:
    most, smaller = CHAIN_WAITS[sweep]
    with PLACES["pretended"].counted() as counts:
        bench = Bench(load(sweep, smaller), str(DEVICE))
        trials = bench.trials(Draws(3, "run", [0, 1]))
        before = waits(counts)
        bench.chains["recommended"].trace(trials.recording)
    found = waits(counts) - before
    assert found.total() <= most, f"{found.total()}, at {dict(found.most_common(8))}"


# their entries hold tensors of the CPU
_HELD = ("metrics.replica_level", "metrics.phase_rmse", "metrics.residual_phase", "metrics.rotation_bounds")
METRICS = [entry for entry in FUNCTIONS if entry.name.startswith("metrics.") and entry.name not in _HELD]


@pytest.mark.parametrize("entry", METRICS, ids=[entry.name for entry in METRICS])
def test_metrics(entry: Entry, place: Place) -> None:
    x = samples(entry.kind, 2, torch.complex128)
    with place.counted():
        found = named(entry.call(place.put(x)))
    equal(place, found, named(entry.call(x)), 1e-9)


# numbers of an instrument, the same for all trials
_SHARED = ("wavelength_m", "prf_hz", "duration_s", "rate_hz_s")


@pytest.mark.parametrize("name", [name for name in NUMBERS if name.startswith("metrics.") and name not in _HELD])
def test_bounds(name: str, place: Place) -> None:
    function, numbers = NUMBERS[name]
    given = {
        key: torch.tensor([x, 1.1 * x], dtype=torch.float64) if isinstance(x, float) and key not in _SHARED else x
        for key, x in numbers.items()
    }
    with place.counted():
        found = named(function(**place.put(given)))
    equal(place, found, named(function(**given)), 1e-9)


def test_detection(place: Place) -> None:
    data = torch.full((64, 48), 0.1, dtype=torch.complex128)
    data[20:24, 30:33] = 3.0
    axes = (Axis("azimuth", 64, 0.0, 10.0, "m"), Axis("range", 48, 0.0, 2.0, "m"))
    (expected,) = detect(Signal(data, axes))
    with place.counted():
        (found,) = detect(Signal(place.put(data), axes))
    assert found == expected


# the device itself


def _refused(f: Callable[[], object]) -> bool:
    try:
        f()
    except RuntimeError as error:
        return "same device" in str(error)
    return False


def test_the_device_refuses_mixed_operands_as_cuda_does() -> None:
    with pretended_device():
        there, here = torch.arange(3.0, device=DEVICE), torch.ones(3)
        assert _refused(lambda: there + here)
        assert _refused(lambda: there.sum() * here)
        assert _refused(lambda: torch.stack([there, here]))
        assert _refused(lambda: here.add_(there.sum()))
        assert _refused(lambda: torch.complex(there, torch.tensor(1.0)))
        assert _refused(lambda: there @ here)
        assert _refused(lambda: here.gather(0, there.long()))
        assert to_host(there * torch.tensor(2.0)).tolist() == [0, 2, 4]
        assert to_host(there[torch.tensor([2, 0])]).tolist() == [2, 0]
        assert to_host(torch.where(there > 1, there, 0.0)).tolist() == [0, 0, 2]
        with pytest.raises(RuntimeError):
            there.numpy()


def test_the_device_counts_what_makes_the_host_wait() -> None:
    def of(f: Callable[[Tensor], object]) -> tuple[int, int]:
        x = to_device(torch.arange(4.0))
        with pretended_device() as counts:
            f(x)
        return counts.waits.total(), counts.uploads.total()

    assert of(lambda x: x.square().sum()) == (0, 0)
    assert of(lambda x: float(x.sum())) == (1, 0)
    assert of(lambda x: bool((x > 1).any())) == (1, 0)
    assert of(lambda x: x.tolist()) == (1, 0)
    assert of(lambda x: x.cpu()) == (1, 0)
    assert of(lambda x: x[x > 1]) == (1, 0)
    assert of(lambda x: x.nonzero()) == (1, 0)
    assert of(lambda x: x[x.argmax()]) == (1, 0)
    assert of(lambda x: torch.linalg.inv(torch.diag(x + 1))) == (1, 0)
    assert of(lambda x: x.masked_fill(x > 1, 0.0)) == (0, 0)
    assert of(lambda x: x.__setitem__(x > 1, 0.0)) == (0, 0)
    assert of(lambda x: x.__setitem__(x > 1, x[:2].clone())) == (1, 0)
    assert of(lambda x: torch.tensor([1.0, 2.0], device=x.device)) == (0, 1)
    assert of(lambda x: torch.ones(4).to(x)) == (0, 1)
    assert of(lambda x: x[torch.tensor([1, 2])]) == (0, 1)
    assert of(lambda x: x[[1, 2]]) == (0, 1)
    assert of(lambda x: torch.full((), 3.0, device=x.device) + x) == (0, 0)


def test_gradients_pass_through_the_device() -> None:
    x = torch.linspace(-1, 1, 5, dtype=torch.float64)
    with pretended_device():
        there = to_device(x).requires_grad_()
        (slope,) = torch.autograd.grad((there.exp() * torch.fft.fft(there).abs()).sum(), there)
    here = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad((here.exp() * torch.fft.fft(here).abs()).sum(), here)
    torch.testing.assert_close(to_host(slope), expected)
