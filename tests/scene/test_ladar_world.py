"""Targets, random motions and worlds of the ladar."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from torchsar.core import Draws
from torchsar.echo import simulate_ladar
from torchsar.radar import TriangularLadar
from torchsar.scene import (
    CalibrationFibre,
    Dwell,
    LadarWorld,
    LetterE,
    LinearInSweep,
    LogAmplitude,
    MeasuredTrack,
    OnePerPeriod,
    OnePerSweep,
    PathFluctuation,
    Points,
    Polynomial,
    RetroAndBrokenLine,
    Sinusoid,
    VibrationSpectrum,
)
from torchsar.scene.ladar_range import RangeHistory
from torchsar.scene.motion import drawn_motion
from torchsar.study.names.files import measured_track


def test_the_letter() -> None:
    """A spine of 17 points 5 cm apart; arms of 15 points 1 cm apart at its points 0, 8 and 16."""
    s = LetterE().scatterers(Draws(1, trials=range(3)))
    assert s.range_m.shape == s.azimuth_m.shape == (62,) and s.amplitude.shape == (3, 62)
    positions = {(round(float(x), 3), round(float(r), 3)) for x, r in zip(s.azimuth_m, s.range_m, strict=True)}
    assert (
        len(positions) == 62
        and {(-0.075, -0.4), (-0.075, 0.4), (0.075, 0.0), (-0.065, 0.4), (-0.075, 0.35)} <= positions
    )
    assert (-0.065, -0.35) not in positions
    torch.testing.assert_close(s.amplitude.abs(), torch.ones(3, 62, dtype=torch.float64))
    assert not torch.equal(s.amplitude[0], s.amplitude[1])
    assert torch.equal(
        LetterE(random_phase=False).scatterers(Draws(1)).amplitude, torch.ones(62, dtype=torch.complex128)
    )


def test_the_ground_target() -> None:
    """A retro-reflector of 25 dB, and nine points 18 dB below it, 0.25 to 0.55 m behind it."""
    s = RetroAndBrokenLine().scatterers(Draws(1, trials=range(2)))
    level = 20 * torch.log10(s.amplitude.abs())
    assert s.range_m.shape == (10,) and float(s.range_m[0]) == 10.5
    torch.testing.assert_close(level, torch.tensor([25.0] + 9 * [7.0], dtype=torch.float64).expand(2, -1))
    beyond = s.range_m[1:] - s.range_m[0]
    assert float(beyond.min()) == pytest.approx(0.25) and float(beyond.max()) == pytest.approx(0.55)
    gaps = torch.diff(beyond)
    assert int((gaps > 1.5 * gaps.min()).sum()) == 2


@pytest.mark.parametrize(
    "kind, slope", [(PathFluctuation, -8 / 3), (VibrationSpectrum, -8 / 3), (LogAmplitude, -5 / 3)]
)
def test_spectra_follow_their_power_law(kind, slope: float) -> None:
    tones = kind(2e-6, lowest_hz=10.0, highest_hz=1000.0, slope=slope, count=50).drawn(Draws(1, trials=range(4)), 1.0)
    power = (tones.cosine.square() + tones.sine.square()) / 2
    torch.testing.assert_close(power.sum(-1), torch.full((4,), 4e-12, dtype=torch.float64), rtol=1e-12, atol=0)
    edges = 10.0 * 100.0 ** (torch.arange(51, dtype=torch.float64) / 50)
    density = (power / torch.diff(edges))[0]
    fitted = np.polyfit(np.log(tones.frequency_hz.numpy()), np.log(density.numpy()), 1)[0]
    assert fitted == pytest.approx(slope, abs=1e-9)
    assert bool((tones.frequency_hz > edges[:-1]).all()) and bool((tones.frequency_hz < edges[1:]).all())


def test_the_default_band_follows_the_recording_and_rms_values_may_differ() -> None:
    tones = PathFluctuation(torch.tensor([1.0, 3.0], dtype=torch.float64)).drawn(Draws(0, trials=range(2)), 0.5)
    assert 2.0 < float(tones.frequency_hz[0]) < 2.3 and 1800 < float(tones.frequency_hz[-1]) < 2000
    power = (tones.cosine.square() + tones.sine.square()).sum(-1) / 2
    torch.testing.assert_close(power, torch.tensor([1.0, 9.0], dtype=torch.float64))
    short = LogAmplitude(0.1).drawn(Draws(0), 1e-4)
    assert 9e4 < float(short.frequency_hz[-1]) < 1e5


def test_tones_are_sums_of_sinusoids_at_any_times() -> None:
    tones = PathFluctuation(1.0, 20.0, 500.0, count=7).drawn(Draws(2, trials=range(2)), 1.0)
    time = torch.rand(3, 7001, dtype=torch.float64)
    expected = sum(
        (
            c[:, None, None] * torch.cos(2 * math.pi * f * time) + s[:, None, None] * torch.sin(2 * math.pi * f * time)
            for f, c, s in zip(tones.frequency_hz, tones.cosine.T, tones.sine.T, strict=True)
        ),
        torch.zeros(2, 3, 7001, dtype=torch.float64),
    )
    torch.testing.assert_close(tones.displacement_m(time), expected, atol=1e-11, rtol=0)
    assert tones.value(torch.tensor(0.3, dtype=torch.float64)).shape == (2,)


def test_random_motions_depend_on_their_address_only() -> None:
    motion = [PathFluctuation(1e-6), Polynomial([0.3]), PathFluctuation(1e-6)]
    time = torch.linspace(0, 0.01, 5, dtype=torch.float64)
    together = drawn_motion(motion, Draws(1, trials=[3, 5]), 0.01)
    alone = drawn_motion(motion, Draws(1, trials=[5]), 0.01)
    torch.testing.assert_close(
        together[0].displacement_m(time)[1], alone[0].displacement_m(time)[0], atol=1e-18, rtol=1e-9
    )
    assert together[1] is motion[1] and not torch.equal(
        together[0].displacement_m(time), together[2].displacement_m(time)
    )


def written(folder: Path, suffix: str, time: np.ndarray, track: np.ndarray) -> Path:
    path = folder / f"track{suffix}"
    if suffix == ".npy":
        np.save(path, np.stack([time, track], -1))
    elif suffix == ".npz":
        np.savez(path, time_s=time, displacement_m=track)
    elif suffix == ".csv":
        path.write_text(
            "time,displacement\n" + "\n".join(f"{t:.17g},{d:.17g}" for t, d in zip(time, track, strict=True))
        )
    else:
        np.savetxt(path, np.stack([time, track], -1), fmt="%.17g", header="time displacement")
    return path


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".npy", ".npz"])
def test_measured_tracks_from_files(tmp_path: Path, suffix: str) -> None:
    time = np.arange(50) * 1e-4
    track = 1e-5 * np.sin(2 * np.pi * 300 * time)
    found = measured_track(str(written(tmp_path, suffix, time, track)))
    at = np.linspace(0, time[-1], 77).reshape(7, 11)
    np.testing.assert_allclose(found.displacement_m(torch.tensor(at)).numpy(), CubicSpline(time, track)(at), atol=1e-17)


def test_unsuitable_measured_tracks_are_refused(tmp_path: Path) -> None:
    (tmp_path / "three.csv").write_text("1,2,3\n4,5,6\n")
    (tmp_path / "words.txt").write_text("no numbers\nat all\n")
    written(tmp_path, ".npy", np.array([0.0, 1.0, 3.0]), np.zeros(3))
    (tmp_path / "cut.npz").write_bytes(written(tmp_path, ".npz", np.arange(3.0), np.zeros(3)).read_bytes()[:99])
    np.save(tmp_path / "complex.npy", np.ones((3, 2)) * 1j)
    for name, message in (
        ("cut.npz", "cut.npz is cut off or damaged"),
        ("complex.npy", "complex.npy must hold real numbers, got complex128"),
        ("three.csv", r"three.csv: expected two columns.*got 3 columns"),
        ("words.txt", "words.txt: expected two columns"),
        ("track.npy", "track.npy: times.*rise evenly"),
        ("none.csv", "none.csv does not exist"),
    ):
        with pytest.raises(ValueError, match=message):
            measured_track(str(tmp_path / name))
    track = MeasuredTrack(torch.arange(4, dtype=torch.float64), torch.zeros(2, 4, dtype=torch.float64))
    assert track.displacement_m(torch.zeros(3, 5, dtype=torch.float64)).shape == (2, 3, 5)
    with pytest.raises(ValueError, match="must lie within -1 to 4 s, one step beyond its ends, got 2 to 9 s"):
        track.displacement_m(torch.tensor([2.0, 9.0], dtype=torch.float64))


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: LadarWorld(Points([0.0], [0.0]), gate_m=(2.0, 1.0)), "gate_m must be"),
        (lambda: LadarWorld(Points([0.0], [0.0]), snr_db=math.nan), "snr_db must be a finite number"),
        (lambda: LadarWorld(Points([0.0], [0.0]), log_amplitude=LogAmplitude(-0.1)), "rms of a log-amplitude"),
        (
            lambda: LinearInSweep(("curvature",)),  # type: ignore[arg-type]
            r"without must be a tuple of the effects to leave out \(residual_video, hyperbola, flight\)",
        ),
        (lambda: LinearInSweep("flight"), "must be a tuple of the effects"),  # type: ignore[arg-type]
        (lambda: CalibrationFibre(0.0), "delay_s of a calibration fibre must be a positive number"),
        (lambda: PathFluctuation(1e-6, 100.0, 10.0), "0 < lowest_hz <= highest_hz"),
        (lambda: VibrationSpectrum(1e-6, 1.0, 10.0, count=0), "count of sinusoids"),
        (
            lambda: PathFluctuation(1e-6, highest_hz=1.0).drawn(Draws(0), 0.1),
            "must not be below lowest_hz, .*; give lowest_hz",
        ),
        (lambda: RetroAndBrokenLine(range_m=math.inf), "range_m of a retro-reflector"),
        (lambda: CalibrationFibre(None), "delay_s of a calibration fibre must be a positive number, got None"),  # type: ignore[arg-type]
        (lambda: LadarWorld(Points([0.0], [0.0]), snr_db="20"), "LadarWorld.snr_db must be a finite .* got '20'"),  # type: ignore[arg-type]
        (lambda: Dwell("a"), "Dwell.dwell_s must be a positive number, got 'a'"),  # type: ignore[arg-type]
        (lambda: Points([None], [0.0]), "azimuth_m of points must be a finite number, .* got None"),  # type: ignore[arg-type]
        (lambda: LetterE(first_range_m=None), "first_range_m of a letter must be a finite number, .* got None"),  # type: ignore[arg-type]
        (lambda: VibrationSpectrum(None, None, 5.0), "rms_m of a random motion must be a finite .* got None"),  # type: ignore[arg-type]
    ],
)
def test_invalid_worlds_are_refused(build, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()


def test_a_fidelity_of_ones_own_derives_from_another() -> None:
    class Still(OnePerPeriod):
        def sweep_range_m(self, history: RangeHistory, middle_s: torch.Tensor) -> tuple:
            return OnePerSweep().sweep_range_m(history, middle_s)

    ladar = TriangularLadar(193e12, 10e9, 1e-3, 256e3, 40.0, reference_range_m=1e3)
    own, known = (
        simulate_ladar(ladar, LadarWorld(Points([0.0], [0.1]), fidelity=model), 3, Draws(0))[0].signal.data
        for model in (Still(()), OnePerSweep(()))
    )
    assert torch.equal(own, known)


def test_another_fidelity_is_refused() -> None:
    with pytest.raises(TypeError, match="fidelity must be .*LinearInSweep.* got the class"):
        LadarWorld(Points([0.0], [0.0]), fidelity=LinearInSweep)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="fidelity must be .*LinearInSweep.* got Sinusoid"):
        LadarWorld(Points([0.0], [0.0]), fidelity=Sinusoid(1.0, 1.0))  # type: ignore[arg-type]
