"""Arguments of another kind than the annotation of their parameter names."""

import pytest
import torch

from torchsar import Chain, Draws, compensate, echo, focus, metrics, plot, radar, scene

STRIP = radar.StripmapRadar(1.3e9, radar.LinearFM(80e6, 1e-6), 100e6, 300.0, 120.0, 4000.0, pointing_doppler_hz=0.0)
ISAR = radar.InverseRadar(10e9, 150e6, 100.0, rotation_rad_s=0.05)
LADAR = radar.TriangularLadar(193e12, 5e9, 16e-6, 64e6, 60.0, 3000.0)
POINT = scene.Points([0.0], [0.0])


class Empty(scene.Scene):
    """Scene without the method of scenes."""


def raw():
    return echo.simulate(STRIP, scene.StripmapWorld(POINT), 64, 128, Draws(1))[0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: scene.StripmapWorld(POINT, 1.0), r"beam must be an object with weight\(.*AlwaysLit\(\).* got 1"),
        (lambda: scene.StripmapWorld([POINT]), r"scene must be an object with scatterers\(draws\), such as Points\("),
        (lambda: scene.StripmapWorld(Empty()), "StripmapWorld: scene must be an object with scatterers.* got Empty"),
        (lambda: scene.TurntableWorld(scene.Points), "got the class Points, not an object of it"),
        (lambda: scene.TurntableWorld(POINT, motion=[POINT]), "motion must be a list of an object with disp"),
        (lambda: scene.Together([POINT]), "parts must be a mapping, such as {'first': x}, with x an object with"),
        (lambda: scene.Points(0.0, 0.0), "azimuth_m must be a list of numbers, got 0"),
        (lambda: echo.simulate(STRIP, scene.StripmapWorld(POINT), 8, 8, 1), r"simulate: draws must be Draws\(seed\)"),
        (lambda: echo.simulate(STRIP, POINT, 8, 8, Draws(1)), r"world must be StripmapWorld\(scene\), got Points"),
        (
            lambda: echo.simulate(STRIP, scene.StripmapWorld(POINT), 64, 128, Draws(1), [echo.Quantiser(2)]),
            "impairments must be a mapping, such as {'first': x}",
        ),
        (lambda: compensate.EffectiveVelocity(STRIP), r"focuser must be OmegaK\(radar\), got StripmapRadar"),
        (lambda: focus.Detect(looks=4), "Detect: looks must be a list of numbers"),
        (lambda: metrics.impulse_response(raw().signal, 60.0), "at_m must be a pair, got 60"),
        (lambda: plot.image(raw()), "got Recording; pass its signal: recording.signal"),
        (lambda: plot.curves({"a": torch.arange(3.0)}, "x", "y"), "series must be a mapping.* with x a pair"),
        (lambda: compensate.Sca(raw().signal.data), "Sca: assess must be True or False, got "),
        (lambda: echo.simulate(LADAR, POINT, 8, 8, Draws(1)), "TriangularLadar; use simulate_ladar or simulate_ladar_"),
        (lambda: echo.simulate(ISAR, POINT, 8, 8, Draws(1)), "InverseRadar; use simulate_path or simulate_turntable$"),
        (lambda: echo.simulate_turntable(STRIP, POINT, 8, 8, Draws(1)), "StripmapRadar; use simulate$"),
        (lambda: plot.save(raw().signal, "image.png"), r"save writes a figure or a list .* got Signal.*plot.image\("),
        (lambda: Chain({"a": focus.OmegaK(STRIP)}), "a chain needs a name for each stage"),
        (lambda: Chain(focus.OmegaK(STRIP)), "a chain needs a name for each stage"),
    ],
)
def test_an_argument_of_another_kind_is_refused_in_one_sentence(call, message):
    with pytest.raises(TypeError, match=message):
        call()


def test_a_recording_without_data_of_its_own_names_those_of_its_signal():
    with pytest.raises(AttributeError, match="a Recording has no 'data'; its signal has it: recording.signal.data"):
        _ = raw().data
    with pytest.raises(AttributeError, match="a Recording has no 'samples'$"):
        _ = raw().samples


@pytest.mark.parametrize(
    "make",
    [
        lambda carrier_hz: radar.InverseRadar(carrier_hz, 150e6, 100.0),
        lambda carrier_hz: radar.StripmapRadar(carrier_hz, STRIP.pulse, 100e6, 300.0, 120.0, 4000.0),
        lambda carrier_hz: radar.TriangularLadar(carrier_hz, 5e9, 16e-6, 64e6, 60.0, 3000.0),
    ],
)
def test_a_carrier_in_other_units_is_refused(make):
    with pytest.raises(ValueError, match=r"carrier_hz must be above half the bandwidth of .* got 9.6 Hz; .* 9.6e9"):
        make(9.6)
    assert make(9.6e9).carrier_hz == 9.6e9


@pytest.mark.parametrize(
    "name, single", [("motion", scene.Sinusoid(1e-3, 1.0)), ("start_phase", scene.UniformStartPhase())]
)
def test_a_single_object_is_accepted_where_a_sequence_is_expected(name, single):
    made = [
        echo.simulate_turntable(ISAR, scene.TurntableWorld(POINT, **{name: given}), 8, 16, Draws(1))[0].signal.data
        for given in (single, [single])
    ]
    assert torch.equal(*made)


def test_an_object_of_a_user_needs_the_methods_only():
    class Corner:
        def scatterers(self, drawn):
            return POINT.scatterers(drawn)

    assert scene.StripmapWorld(Corner()).scene.scatterers(Draws(1)).range_m.tolist() == [0.0]
