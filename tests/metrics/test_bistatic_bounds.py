"""Bounds of a moving point against the closed form, figures of an independent float64 model, and
Fisher information from numerical differences.
"""

from __future__ import annotations

import math

import pytest
import torch

from tests.helpers import radial_velocity_bound_m_s
from torchsar.metrics.bistatic_bounds import UNKNOWNS, bistatic_bounds
from torchsar.study.bench.direct.moving import published_radar, range_of, time_of

F64 = torch.float64
RADAR = published_radar()
STEPS = {"u_r_m_s": 1e-5, "u_a_m_s": 1e-5, "y0_m": 1e-4}


def samples(unknown: dict[str, float], n_pulse: int, gate) -> torch.Tensor:
    time = time_of(RADAR, n_pulse)
    path = range_of(RADAR, time, unknown["u_r_m_s"], unknown["u_a_m_s"], unknown["y0_m"])
    return gate(unknown, time, path) * torch.exp(-2j * math.pi * torch.remainder(path / RADAR.wavelength_m, 1))


def rectangle(unknown, time, path):
    return ((time - unknown["y0_m"] / (300 - unknown["u_a_m_s"])).abs() < 2.25).to(F64).expand(path.shape)


def pattern(unknown, time, path):
    dx = torch.tensor(RADAR.channel_m, dtype=F64)[:, None]
    return torch.sinc(0.8 / 0.24 * ((300 - unknown["u_a_m_s"]) * time - unknown["y0_m"] - dx) / path)


def brute_force(
    at: dict[str, float], names, snr: float, n_pulse: int, gate, differentiated_gate=None, covariance=None
) -> list[float]:
    """Bounds from central differences of all samples by the unknowns and by both parts of the
    amplitude; the gate is constant unless `differentiated_gate` is given.
    """
    held = lambda unknown, time, path: gate(at, time, range_of(RADAR, time, at["u_r_m_s"], at["u_a_m_s"], at["y0_m"]))  # noqa: E731
    moving = differentiated_gate or held
    columns = [
        (
            samples({**at, name: at[name] + STEPS[name]}, n_pulse, moving)
            - samples({**at, name: at[name] - STEPS[name]}, n_pulse, moving)
        )
        / (2 * STEPS[name])
        for name in names
    ]
    point = samples(at, n_pulse, gate)
    stacked = torch.stack([*columns, point, 1j * point], -1)
    if covariance is None:
        white = stacked.flatten(0, 1)
    else:
        spectra = torch.fft.fft(stacked, dim=1) / math.sqrt(n_pulse)
        value, vector = torch.linalg.eigh(covariance)
        root = vector @ torch.diag_embed(value.rsqrt().to(vector.dtype)) @ vector.mH
        white = (root @ spectra.movedim(0, 1)).flatten(0, 1)
    information = 2 * snr * (white.mH @ white).real
    size = information.diagonal().rsqrt()
    inverse = torch.linalg.inv(information * size[:, None] * size)
    return (inverse.diagonal().sqrt() * size)[: len(names)].tolist()


def test_published_figures_at_zero_db():
    args = (RADAR, 900, 1.0, 10.0)
    found = float(bistatic_bounds(*args, integration_s=4.5)["u_r_m_s"])
    assert found == pytest.approx(0.251, abs=0.002)
    assert found == pytest.approx(radial_velocity_bound_m_s(RADAR, 1.0, 810), rel=0.01)
    assert float(bistatic_bounds(*args, integration_s=4.5, unknown=("u_r_m_s", "y0_m"))["u_r_m_s"]) == pytest.approx(
        0.148, abs=0.001
    )
    assert float(bistatic_bounds(*args, integration_s=4.5, unknown=("u_r_m_s",))["u_r_m_s"]) == pytest.approx(
        0.00042, abs=0.00001
    )


def test_bounds_fall_as_the_root_of_the_snr_in_each_trial():
    u_r, snr = torch.tensor([[-7.0], [0.0], [12.0]], dtype=F64), torch.tensor([1.0, 100.0], dtype=F64)
    found = bistatic_bounds(RADAR, 900, snr, u_r, 3.0, 20.0, integration_s=4.5)
    assert tuple(found) == UNKNOWNS
    for name, values in found.items():
        assert values.shape == (3, 2) and values.dtype == F64
        torch.testing.assert_close(values[:, 0], 10 * values[:, 1])
        one = bistatic_bounds(RADAR, 900, 100.0, -7.0, 3.0, 20.0, integration_s=4.5)[name]
        assert float(one) == pytest.approx(float(values[0, 1]), rel=1e-9)


@pytest.mark.parametrize("names", [UNKNOWNS, ("u_r_m_s", "y0_m"), ("y0_m", "u_a_m_s")])
def test_phases_against_numerical_differences(names):
    at = {"u_r_m_s": 10.0, "u_a_m_s": 5.0, "y0_m": 40.0}
    found = bistatic_bounds(RADAR, 900, 3.0, 10.0, 5.0, 40.0, integration_s=4.5, unknown=names)
    assert [float(found[name]) for name in names] == pytest.approx(
        brute_force(at, names, 3.0, 900, rectangle), rel=1e-4
    )


@pytest.mark.parametrize("tells", [False, True])
def test_patterns_against_numerical_differences(tells):
    at = {"u_r_m_s": -8.0, "u_a_m_s": 10.0, "y0_m": -30.0}
    found = bistatic_bounds(RADAR, 1800, 2.0, -8.0, 10.0, -30.0, gate_tells=tells)
    expected = brute_force(at, UNKNOWNS, 2.0, 1800, pattern, pattern if tells else None)
    assert [float(found[name]) for name in UNKNOWNS] == pytest.approx(expected, rel=1e-4)


def clutter(n_pulse: int, cnr: float) -> torch.Tensor:
    """Stationary scene in the band of a 4.5 s aperture, plus unit noise, (n_pulse, channel,
    channel).
    """
    total = torch.eye(3, dtype=torch.complex128).repeat(n_pulse, 1, 1)
    for band in (-1, 0, 1):
        doppler = torch.fft.fftfreq(n_pulse, 1 / 180, dtype=F64) + 180 * band
        seen = torch.exp(-2j * math.pi * doppler[:, None] * torch.tensor(RADAR.channel_m, dtype=F64) / 300)
        total = total + cnr * (doppler.abs() < 168.75)[:, None, None] * seen[:, :, None] * seen[:, None].conj()
    return total


def test_clutter_against_numerical_differences_and_white_noise():
    at, covariance = {"u_r_m_s": 6.0, "u_a_m_s": 0.0, "y0_m": 10.0}, clutter(900, 300.0)
    found = bistatic_bounds(RADAR, 900, 5.0, 6.0, 0.0, 10.0, integration_s=4.5, covariance=covariance)
    expected = brute_force(at, UNKNOWNS, 5.0, 900, rectangle, covariance=covariance)
    assert [float(found[name]) for name in UNKNOWNS] == pytest.approx(expected, rel=1e-4)
    white = bistatic_bounds(RADAR, 900, 5.0, 6.0, 0.0, 10.0, integration_s=4.5)
    noise = bistatic_bounds(
        RADAR,
        900,
        5.0,
        6.0,
        0.0,
        10.0,
        integration_s=4.5,
        covariance=4 * torch.eye(3, dtype=torch.complex128).expand(900, 3, 3),
    )
    for name in UNKNOWNS:
        assert float(noise[name]) == pytest.approx(2 * float(white[name]), rel=1e-6)
        assert float(found[name]) > 1.5 * float(white[name])


def test_bounds_of_unobservable_unknowns_are_infinite():
    # illuminated after the record
    nowhere = bistatic_bounds(RADAR, 900, 1.0, 0.0, 0.0, 5000.0, integration_s=4.5)
    assert all(math.isinf(float(value)) for value in nowhere.values())
    single = published_radar(channel_m=(0.0,))
    assert float(bistatic_bounds(single, 900, 1.0, 10.0, integration_s=4.5)["u_r_m_s"]) > 3


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"unknown": ("u_r",)}, "unknown must name some of"),
        ({"unknown": ()}, "unknown must name some of"),
        ({"integration_s": -1.0}, "must be positive"),
        ({"integration_s": 4.5, "gate_tells": True}, "gate_tells needs the antenna pattern"),
        ({"range_m": torch.tensor([8e3, 0.0])}, "range_m must be positive"),
        ({"covariance": torch.eye(3)}, "n_pulse, channel, channel"),
    ],
)
def test_invalid_arguments_raise(changes, match):
    with pytest.raises(ValueError, match=match):
        bistatic_bounds(RADAR, 64, 1.0, **changes)
