"""Prompts and notebooks show kinds, spans and connections of objects, and no dumps of numbers."""

from __future__ import annotations

from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import torchsar
from tests.helpers import small_radar
from torchsar import compensate, focus, scene
from torchsar.core import Axis, Estimate, Outcome, Recording, Signal, Stage, Truth, use
from torchsar.core.show import in_bytes, some_of

AXES = (Axis("pulse", 4, 0.0, 0.5, "s"), Axis("range", 1000, 700e3, 0.6, "m"))


class Gain(Stage):
    """Estimates a number."""

    works_on = ("pulse", "range")
    provides = ("gain_db",)
    neutral = {"gain_db": 0.0}

    def forward(self, x: Signal) -> Estimate:
        trials = x.data.new_zeros(x.trials).real
        of = torch.tensor([Outcome.NOISE, Outcome.MISFIT, Outcome.OK])[: trials.numel()].reshape(trials.shape)
        return Estimate({"gain_db": trials + 3}, {"gain_db": trials + 0.25}, trials, of)


class Amplify(nn.Module):
    """Uses it."""

    def forward(self, x: Signal, gain_db: torch.Tensor) -> Signal:
        return x.with_data(x.data * 2)


def chain() -> torchsar.Chain:
    return torchsar.Chain(gain=Gain(), louder=use(Amplify(), gain_db="gain"))


def signal(*trials: int) -> Signal:
    return Signal(torch.zeros(*trials, 4, 1000, dtype=torch.complex64), AXES)


def objects() -> dict[str, Any]:
    recording = Recording(signal(3), Gain(), {"line_number": torch.arange(4)})
    trace = chain().trace(recording)
    truth = Truth({"snr_db": torch.zeros(3)}, recording)
    return {
        "signal": recording.signal,
        "recording": recording,
        "truth": truth,
        "trace": trace,
        "estimate": trace.estimates["gain"],
        "chain": chain(),
    }


class Checked(HTMLParser):
    """Raises AssertionError for elements that are not closed, and for what needs a network."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words = ""
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in ("div", "strong", "table", "tr", "th", "td"), tag
        assert not {name for name, _ in attrs} - {"style", "colspan"}
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += f" {data}"


def test_a_signal_has_kind_device_size_and_spans() -> None:
    assert repr(signal()) == (
        "Signal(complex64 (4, 1000), cpu, 32 kB; pulse: 4, 0 to 1.5 s; range: 1000, 700000 to 700599 m)"
    )


def test_a_text_that_is_too_long_has_a_line_for_each_part() -> None:
    assert repr(signal(30, 20)).splitlines() == [
        "Signal(complex64 (30, 20, 4, 1000), cpu, 19.2 MB",
        "  pulse: 4, 0 to 1.5 s",
        "  range: 1000, 700000 to 700599 m)",
    ]


def test_one_number_of_an_estimate_is_shown_and_several_are_not() -> None:
    one = Estimate(
        {"doppler_hz": torch.tensor(24.9)},
        outcome=Outcome.OK.like(torch.ones(())),
    )
    assert repr(one) == "Estimate(ok in 1 of 1, cpu; doppler_hz: 24.9)"
    assert repr(Estimate(one.value)) == "Estimate(not assessed, cpu; doppler_hz: 24.9)"


def test_an_estimate_shows_the_reasons_with_their_counts() -> None:
    assert repr(objects()["estimate"]).splitlines() == [
        "Estimate(ok in 1 of 3 (misfit: 1, noise: 1), cpu",
        "  gain_db: float32 (3,), standard deviation float32 (3,)",
        f"  misfit: 1 of 3, {Outcome.MISFIT.message}",
        f"  noise: 1 of 3, {Outcome.NOISE.message})",
    ]


def test_a_chain_shows_its_connections() -> None:
    parts = ("Chain(2 stages", "gain: Gain, estimates gain_db", "louder: Amplify, uses gain_db from gain.gain_db")
    assert repr(chain()) == "; ".join(parts) + ")"
    careful = torchsar.Chain(gain=Gain(), louder=use(Amplify(), gain_db="gain", in_doubt="neutral"))
    assert repr(careful).splitlines() == [parts[0], f"  {parts[1]}", f"  {parts[2]} (neutral if doubtful))"]
    assert "gain_db from gain.gain_db" in Checked(chain()._repr_html_()).words


def test_a_trace_shows_signals_verdicts_and_times() -> None:
    words = Checked(objects()["trace"]._repr_html_()).words
    assert (
        "complex64 (3, 4, 1000) of pulse and range" in words and "gain_db ok in 1 of 3 (misfit: 1, noise: 1)" in words
    )
    assert "gain_db neutral in 1 of 3 and gain_db doubtful in 1 of 3" in words
    assert words.rstrip().endswith(" s")


@pytest.mark.parametrize("name", ("signal", "recording", "truth", "trace", "estimate", "chain"))
def test_a_notebook_gets_small_html_with_the_words_of_the_text(name: str) -> None:
    shown = objects()[name]
    html = shown._repr_html_()
    words = Checked(html).words
    assert len(html) < 2000 and len(repr(shown)) < 500
    for line in repr(shown).strip("()").replace("(", " ", 1).splitlines()[1:]:
        part, _, rest = line.strip(" )").partition(": ")
        assert f" {part} " in words and all(one in words for one in rest.split(", ") if "(" not in one)


def test_html_escapes_names() -> None:
    aux = {"<script>alert(1)</script>": torch.zeros(4)}
    assert "<script>" in Checked(Recording(signal(), None, aux)._repr_html_()).words  # as text


def test_a_large_signal_is_shown_without_reading_it() -> None:
    large = Signal(torch.empty(1000, 4, 1000, dtype=torch.complex64, device="meta"), AXES)  # has no values
    assert "32 MB" in repr(large) and "meta" in large._repr_html_()


def test_objects_are_shown_within_vmap() -> None:
    seen = []

    def look(x: Signal) -> Signal:
        seen.append(
            repr(
                Estimate(
                    {"a_m": x.data.real[0, 0]},
                    quality=x.data.real[0, 0],
                    outcome=Outcome.of(x.data.real[0, 0] > 0, Outcome.NOISE),
                )
            )
        )
        return x

    torch.func.vmap(look)(signal(3))
    assert seen == ["Estimate(outcome of shape (), cpu; a_m: float32 ())"]


def test_sizes_and_lists_are_short() -> None:
    assert [in_bytes(x) for x in (12, 1536, 6.3e6, 2e9, 5e15)] == ["12 bytes", "1.54 kB", "6.3 MB", "2 GB", "5e+03 TB"]
    assert some_of((0.0, 10.0)) == "0, 10" and some_of([1.0, 2.0, 3.0, 4.0, 5.0]) == "1 to 5"


def test_the_record_of_a_sweep_shows_its_axes_and_metrics() -> None:
    study = pytest.importorskip("torchsar.study")
    record = study.sweep(
        lambda point, draws: {"mean": {"error_m": draws.normal("x") + point["snr_db"]}},
        {"snr_db": [0.0, 10.0]},
        trials=3,
    )
    shown = "Record(6 of 6 trials done; algorithm: 1, mean; snr_db: 2, 0, 10; trial: 3; error_m)"
    assert repr(record) == shown
    assert "snr_db" in Checked(record._repr_html_()).words


def test_a_signal_behaves_like_an_array_where_that_has_one_meaning() -> None:
    x = signal(3)
    x.data[1] = 2j
    assert x.shape == (3, 4, 1000) and float(abs(x).sum()) == 8000
    assert np.asarray(x).dtype == np.complex64 and np.array_equal(x.numpy(), np.asarray(x))
    assert x[1].trials == () and torch.equal(x[1].data, x.data[1]) and x[1:].trials == (2,) and x[1].axes == x.axes
    assert [float(abs(one).max()) for one in x] == [0, 2, 0]
    for wrong in (lambda: x[0, 1], lambda: x[0][0], lambda: list(x[0]), lambda: x[..., 0]):
        with pytest.raises(IndexError, match=r"chooses trials, .* trial dimensions \(3?,?\); .*isel\(pulse=0\)"):
            wrong()


def test_stages_show_the_arguments_given_to_them() -> None:
    assert repr(compensate.Pga(iterations=3, assess=False)) == "Pga(iterations=3, assess=False)"
    assert repr(focus.OmegaK(small_radar(), velocity_m_s=120.0)) == "OmegaK(radar=StripmapRadar, velocity_m_s=120)"
    assert repr(Gain()) == "Gain()"


def test_a_recording_in_place_of_its_signal_gets_a_hint() -> None:
    with pytest.raises(TypeError, match=r"got Recording; pass its signal: recording\.signal"):
        compensate.Sca()(Recording(signal(3), Gain(), {}))


def test_scenes_and_radars_show_tensors_by_their_kind() -> None:
    shown = repr(scene.Points(azimuth_m=torch.arange(100.0), range_m=torch.zeros(100)))
    assert shown.startswith("Points(azimuth_m=float32 (100,), range_m=float32 (100,), amplitude=")
    assert "carrier_hz=" in repr(small_radar())


def test_plain_modules_get_samples_and_those_that_say_so_the_signal() -> None:
    class Double(nn.Module):
        def forward(self, x, gain=2.0):
            return x * gain

    x = signal(2)
    x.data[:] = 1
    assert torch.equal(torchsar.Chain(a=Double(), b=nn.Identity())(x).data, 2 * x.data)
    assert torchsar.Chain(gain=Gain(), louder=use(Amplify(), gain_db="gain"))(x).shape == x.shape
    with pytest.raises(ValueError, match=r"stage 'a' \(Flatten\) made \(2, 4000\) of samples \(2, 4, 1000\)"):
        torchsar.Chain(a=nn.Flatten())(x)
