"""Small instruments and scenes that several tests share."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchsar.core import Draws, Recording, Signal, Truth
from torchsar.echo import simulate, simulate_bistatic, simulate_ladar, simulate_ladar_record
from torchsar.radar import LIGHT_M_S, BistaticRadar, LinearFM, StripmapRadar, TriangularLadar
from torchsar.scene import (
    AlwaysLit,
    BandLimited,
    BistaticWorld,
    Dwell,
    LadarWorld,
    MovingPoints,
    Points,
    Polynomial,
    StripmapWorld,
)

compiles_stages = pytest.mark.skipif(
    tuple(map(int, torch.__version__.split("+")[0].split(".")[:2])) < (2, 13),
    reason="torch.compile takes stages as arguments since torch 2.13",
)


def enable_interrupts() -> None:
    """For the child of a Popen: tests that were started in the background ignore Ctrl-C, and their
    children would, too.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def assert_forward_equals_backward(
    function: Callable[..., Tensor | tuple[Tensor, ...]], inputs: tuple[Tensor, ...]
) -> None:
    """Derivatives of both modes in a random direction, of all inputs and of the first one alone.

    It costs three calls of the function; `gradcheck(..., check_forward_ad=True)` costs dozens.
    """
    source = torch.Generator().manual_seed(1)

    def alike(x: Tensor) -> Tensor:
        return torch.randn(x.shape, dtype=x.dtype, generator=source)

    def results(*given: Tensor) -> tuple[Tensor, ...]:
        out = function(*given)
        return out if isinstance(out, tuple) else (out,)

    def products(left: Sequence[Tensor], right: Sequence[Tensor]) -> Tensor:
        return torch.cat([(a.conj() * b).real.flatten() for a, b in zip(left, right, strict=True)])

    out = results(*inputs)
    chosen = [i for i, y in enumerate(out) if y.requires_grad]
    weights, directions = [alike(out[i]) for i in chosen], [alike(x) for x in inputs]
    slopes = torch.autograd.grad([out[i] for i in chosen], inputs, weights, materialize_grads=True)
    for count in {1, len(inputs)}:
        wanted = products(slopes[:count], directions[:count])
        with forward_ad.dual_level():
            moved = [forward_ad.make_dual(x.detach(), t) for x, t in zip(inputs[:count], directions[:count])]
            tangents = [
                forward_ad.unpack_dual(y).tangent for y in results(*moved, *(x.detach() for x in inputs[count:]))
            ]
            changes = [torch.zeros_like(out[i]) if tangents[i] is None else tangents[i] for i in chosen]
            found = products(weights, changes).sum()
        assert abs(found - wanted.sum()) <= 1e-7 * wanted.abs().sum(), (count, float(found), float(wanted.sum()))


def small_radar(**changes: object) -> StripmapRadar:
    """A short-range S-band radar whose apertures fit a hundred pulses: cheap, with real
    migration.
    """
    values: dict = {
        "carrier_hz": 3.2e9,
        "pulse": LinearFM(40e6, 0.5e-6),
        "sampling_hz": 50e6,
        "prf_hz": 400.0,
        "velocity_m_s": 120.0,
        "near_range_m": 4000.0,
        "pointing_doppler_hz": 0.0,
    }
    return StripmapRadar(**{**values, **changes})


def kondor_radar(**changes: object) -> StripmapRadar:
    """A sensor like Kondor with a short pulse."""
    values: dict = {
        "carrier_hz": 3.2e9,
        "pulse": LinearFM(200e6, 3e-6),
        "sampling_hz": 250e6,
        "prf_hz": 4000.0,
        "velocity_m_s": 7000.0,
        "near_range_m": 700e3,
        "pointing_doppler_hz": 0.0,
    }
    return StripmapRadar(**{**values, **changes})


def small_recording(
    n_pulse: int = 128,
    n_range: int = 96,
    trials: int | None = None,
    snr_db: float | None = 20.0,
    dwell_s: float | None = 0.2,
    **kwargs,
) -> tuple[Recording, Truth]:
    """Three points seen by the small radar."""
    scene = Points([0.0, 6.0, -9.0], [0.0, 30.0, -45.0], [1.0, 0.7, 0.5], random_phase=True)
    world = StripmapWorld(
        scene,
        Dwell(dwell_s) if dwell_s else AlwaysLit(),
        snr_db=snr_db,
        velocity_m_s=kwargs.pop("velocity_m_s", None),
        doppler_hz=kwargs.pop("doppler_hz", None),
    )
    draws = Draws(kwargs.pop("seed", 1), trials=None if trials is None else range(trials))
    return simulate(kwargs.pop("radar", None) or small_radar(), world, n_pulse, n_range, draws, **kwargs)


def small_ladar(**changes: object) -> TriangularLadar:
    """The simulated ladar of Remote Sens. 2024, 16, 793, with 32 samples a sweep: a beat band of
    half a metre to either side.
    """
    values: dict = {
        "carrier_hz": LIGHT_M_S / 1.55e-6,
        "bandwidth_hz": 5e9,
        "period_s": 16e-6,
        "sample_rate_hz": 4e6,
        "speed_m_s": 60.0,
        "reference_range_m": 3000.0,
    }
    return TriangularLadar(**{**values, **changes})


def small_ladar_recording(
    n_period: int = 48,
    trials: int | None = None,
    dtype: torch.dtype = torch.complex128,
    record: bool = False,
    seed: int = 1,
    **changes,
) -> tuple[Recording, Truth]:
    """Two points seen by the small ladar, in accelerated motion: separated sweeps, or a continuous
    record.
    """
    world = LadarWorld(
        Points([0.0, 0.01], [0.1, 0.25], [1.0, 0.5], random_phase=True), motion=(Polynomial([0.06, 10.0]),), snr_db=20.0
    )
    draws = Draws(seed, trials=None if trials is None else range(trials))
    simulated = simulate_ladar_record if record else simulate_ladar
    return simulated(small_ladar(**changes), world, n_period, draws, dtype=dtype)


def small_bistatic(**changes: object) -> BistaticRadar:
    """The receiver of Remote Sens. 2020, 12, 1703, with a short pulse."""
    values: dict = {
        "carrier_hz": 1.25e9,
        "pulse": LinearFM(50e6, 0.2e-6),
        "sampling_hz": 60e6,
        "prf_hz": 180.0,
        "speed_m_s": 300.0,
        "reference_range_m": 5000.0,
        "transmit_range": (-3.0, 0.02),
    }
    return BistaticRadar(**{**values, **changes})


def small_bistatic_echo(
    n_pulse: int = 48, n_range: int = 32, trials: int | None = None, dtype: torch.dtype = torch.complex128
) -> Signal:
    """Two moving points in noise, range compressed, (channel, pulse, range)."""
    world = BistaticWorld(
        MovingPoints([3.0, -4.0], [1.0, 2.0], [0.0, 5.0], [0.0, 20.0], random_phase=True), BandLimited(4.0), snr_db=20.0
    )
    return simulate_bistatic(
        small_bistatic(),
        world,
        n_pulse,
        n_range,
        Draws(1, trials=None if trials is None else range(trials)),
        dtype=dtype,
    )[0].signal


def radial_velocity_bound_m_s(radar: BistaticRadar, snr: float, n_seen: int, u_a_m_s: float = 0.0) -> float:
    """Bound of the slant-range speed of a moving point from the phases between the channels.

    It is v lambda / (2 pi sqrt(2 Ns snr sum (dx_m - mean dx)^2)) for the along-track speed v of the
    receiver relative to the point and the positions dx_m of the channels; along-track speed,
    position and amplitude are unknown.
    """
    along_m = radar.channels_at()
    spread = float((along_m - along_m.mean()).square().sum())
    return (radar.speed_m_s - u_a_m_s) * radar.wavelength_m / (2 * math.pi * math.sqrt(2 * n_seen * snr * spread))
