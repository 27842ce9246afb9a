"""Reports of runs: numbers with prefixes, pictures to scale, panels that wrap."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.image import imread

from tests.study.tiny import TINY, write_tiny
from torchsar import plot
from torchsar.cli import main
from torchsar.core import Axis, Signal
from torchsar.metrics.cuts import about_peak, finer, impulse_cuts
from torchsar.metrics.image import rolled_to
from torchsar.metrics.impulse import impulse_response
from torchsar.study.output.numbers import number, quantity, scale_of
from torchsar.study.output.report import Picture, before_and_after, comparisons, draw_all, run_fields
from torchsar.study.trials.system import Column

# --- numbers


@pytest.mark.parametrize(
    "value, unit, sd, text",
    [
        (1.758e-05, "m/s", None, "17.58 um/s"),
        (1.7583e-05, "m/s", 4.2e-7, "17.58 ± 0.42 um/s"),
        (0.0812, "rad", 0.0219, "81 ± 22 mrad"),
        (1234.0, "", 346.0, "1,230 ± 350"),
        (0.5, "", 0.0996, "0.50 ± 0.10"),
        (1e-9, "m", 2.5e-3, "0.0 ± 2.5 mm"),
        (-27.431, "dB", 0.114, "-27.43 ± 0.11 dB"),
        (3.2e9, "Hz", None, "3.200 GHz"),
        (0.00012, "dB", None, "0.00012 dB"),
        ([1.5e-3, 2.5e-3], "m", [1e-4, 2e-4], "1.50 ± 0.10, 2.50 ± 0.20 mm"),
        (-1e-12, "m", 4e-6, "0.0 ± 4.0 um"),
        (None, "m", None, "–"),
        (math.nan, "m", 1.0, "–"),
        ("auto", "m", None, "auto"),
        (True, "m", None, "yes"),
    ],
)
def test_quantities_have_prefixes_and_two_digits_of_uncertainty(
    value: object, unit: str, sd: object, text: str
) -> None:
    assert quantity(value, unit, sd) == text


def test_a_row_has_one_prefix() -> None:
    assert scale_of([1e-5, 2e-6, None, math.inf], "m") == (1e6, "um")
    assert scale_of([], "m") == (1.0, "m") and scale_of([1e-5], "nats") == (1.0, "nats")
    assert number([0.25, None, True]) == "0.2500, –, yes"


def test_estimates_have_the_unit_of_their_name() -> None:
    assert plot.name_and_unit("motion.velocity_m_s") == ("velocity", "m/s")
    assert plot.name_and_unit("k1_per_s") == ("k1", "1/s") and plot.name_and_unit("k2_per_s2") == ("k2", "1/s²")
    assert plot.name_and_unit("world.noise.snr_db") == ("SNR", "dB") and plot.name_and_unit("ok") == ("ok", "")


def test_tables_show_uncertainties_of_trials() -> None:
    row = {"velocity_rmse_m_s": 1.7583e-5, "velocity_rmse_m_s_sd": 4.2e-7, "seconds": 1.25, "seconds_sd": 0.5}
    method = {"metrics": row, "cases": {"all": row}, "estimates": {}, "targets": {}, "outcomes": {}}
    tree = {"methods": {"recommended": method}, "published": {}, "published_targets": {}}
    columns = {"velocity_rmse_m_s": Column("velocity error", "m/s"), "seconds": Column("time", "s")}
    fields = run_fields(tree, columns, {})
    assert fields["tables"][0]["rows"] == [("velocity error (um/s)", [["17.58 ± 0.42"]]), ("time (s)", [["1.250"]])]


def test_published_values_stand_beside_those_of_their_method() -> None:
    """The first column is that of the recommended method."""
    row = {"gain_db": 1.5, "width_m": 2e-3}
    methods = {name: {"cases": {"one": row}, "targets": {}, "outcomes": {}} for name in ("none", "recommended")}
    methods["recommended"]["estimates"] = {}
    published = {"gain_db": {"one": {"recommended": "below 2"}}, "width_m": {"one": {"none": 3e-3}, "two": {}}}
    tree = {"methods": methods, "published": published, "published_targets": {}}
    columns = {"gain_db": Column("gain", "dB"), "width_m": Column("width", "m"), "lost": Column("lost")}
    rows = run_fields(tree, columns, {})["tables"][0]["rows"]
    assert rows == [
        ("gain (dB)", [["1.500", "(below 2)"], ["1.500"]]),
        ("width (mm)", [["2"], ["2", "(3)"]]),
    ]


# --- pictures


def image(rows: int, columns: int, step: tuple[float, float] = (0.1, 0.1), unit: str = "m") -> Signal:
    axes = Axis("azimuth", rows, 0.0, step[0], unit), Axis("range", columns, 0.0, step[1], "m")
    return Signal(torch.ones(rows, columns, dtype=torch.complex64), axes)


def test_images_in_metres_have_one_scale_unless_they_are_too_elongated() -> None:
    for signal, aspect in (
        (image(40, 80), 1.0),
        (image(80, 40, (0.2, 0.1)), 1.0),
        (image(40, 80, unit="Hz"), "auto"),
        (image(10, 900), "auto"),
    ):
        assert plot.image(signal).axes[0].get_aspect() == aspect
        assert [figure.axes[0].get_aspect() for figure in plot.images({"a": signal, "b": signal})] == [aspect] * 2


def test_a_picture_of_a_tensor_is_refused_with_the_way_out() -> None:
    with pytest.raises(TypeError, match=r"signal must be Signal\(data, axes\), got float32"):
        plot.image(torch.zeros(4, 4))  # type: ignore[arg-type]


def test_a_crop_holds_every_position_and_stays_inside() -> None:
    signal = image(100, 200)
    at = torch.tensor([1.0, 4.5, 9.0])
    part = plot.within(signal, {"azimuth": plot.span(at, 0.3), "range": (-5.0, 3.0), "pulse": (0.0, 1.0)})
    azimuth, range_ = part.axes
    assert azimuth.start <= 0.71 and azimuth.stop >= 9.29 and azimuth.n < 100
    assert (range_.start, range_.n) == (0.0, 31)
    assert plot.within(signal, {"range": (50.0, 60.0)}).axes[1].n == 2


def test_text_has_nine_pixels_on_a_page_of_420() -> None:
    """Figures fill the 386 pixels that such a page leaves; the smallest text is of 9 points."""
    signal, x = image(20, 20), np.arange(4.0)
    part = {"title": "t", "x": x, "series": {"a": (x + 1, np.stack([x, x + 2], -1))}, "bounds": {}}
    curve = {"series": {"a": (x, x), "b": (x, x)}, "xlabel": "x (m)", "ylabel": "y (m)"}
    figures = [plot.image(signal), *plot.images({"a": signal, "b": signal}), *plot.panels([curve] * 3)]
    figures += [*plot.error_curves([part], "x", "y"), *plot.error_curves([part] * 4, "x", "y")]
    for figure in figures:
        texts = figure.findobj(lambda one: hasattr(one, "get_fontsize"))
        sizes = [text.get_fontsize() for text in texts if text.get_text()]
        assert min(sizes) / 72 * 386 / figure.get_figwidth() >= 9.0


def test_empty_panels_are_left_out_and_the_others_share_a_scale() -> None:
    x = np.array([1.0, 2.0])
    level, wide = np.array([1.0, 2.0]), np.array([0.5, 30.0])
    nothing = np.full(2, np.nan)
    parts = [
        {"title": str(i), "x": x, "series": {"a": (y, np.stack([y, y], -1))}, "bounds": {}}
        for i, y in enumerate((level, nothing, wide))
    ]
    for log in (False, True):
        figures = plot.error_curves(parts, "x", "y", log_y=log)
        assert [figure.axes[0].get_title() for figure in figures] == ["0", "2"]
        assert figures[0].axes[0].get_ylim() == figures[1].axes[0].get_ylim()
    assert plot.error_curves(parts[1:2], "x", "y") == []
    cells = [{"title": str(i), "x": [1, 2], "y": [1], "z": z} for i, z in enumerate((nothing[None], level[None]))]
    assert [figure.axes[0].get_title() for figure in plot.heat_map(cells, "x", "y", "z")] == ["1"]


def test_a_metric_that_is_zero_everywhere_has_no_picture() -> None:
    metrics = {name: {"lost_m": torch.zeros(2), "left_m": torch.full((2,), 1e-3)} for name in ("ideal", "a", "b")}
    columns = {key: Column(key, "m", drawn="rms") for key in ("lost_m", "left_m")}
    drawn = comparisons(dict.fromkeys(("1 mm", "1 cm"), SimpleNamespace(metrics=metrics)), columns)
    assert [name for name, *_ in drawn] == ["left_m"]


def test_curves_of_like_size_share_a_panel() -> None:
    sizes = {"a": 1.0, "b": 500.0, "c": 3.0}
    curves = {name: (None, torch.tensor([0.0, size, math.nan])) for name, size in sizes.items()}
    assert [list(group) for group in plot.alike(curves)] == [["c", "a"], ["b"]]
    assert [len(group) for group in plot.alike(curves, largest=1)] == [1, 1, 1]


def test_panels_in_one_file_lie_row_by_row(tmp_path: Path) -> None:
    figures = []
    for colour in ("red", "lime", "blue"):
        figure = Figure(figsize=(1.0, 0.5), facecolor=colour)
        figures.append(figure)
    plot.save(figures, tmp_path / "sheet.png", dpi=100, columns=2)
    sheet = imread(tmp_path / "sheet.png")[..., :3]
    assert sheet.shape == (100, 200, 3)
    assert [sheet[at].tolist() for at in ((25, 50), (25, 150), (75, 50), (75, 150))] == [
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, 1],
        [1, 1, 1],
    ]


def test_pictures_of_several_panels_have_a_file_each(tmp_path: Path) -> None:
    figure = Figure(figsize=(1.0, 1.0))
    made = [("one", "first", "", figure), ("none", "gone", "", []), ("two: words", "second", "", [figure, figure])]
    pictures = draw_all([lambda: iter(made)], tmp_path / "figures")
    assert [(p.files, p.title) for p in pictures] == [
        (("01_one.png",), "First"),
        (("02_two_words_1.png", "02_two_words_2.png"), "Second"),
    ]
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == [f for p in pictures for f in p.files]


# --- finer grids


def test_cuts_show_ten_side_lobes_of_oversampled_responses() -> None:
    axes = Axis("azimuth", 1024, 0.0, 0.1, "m"), Axis("range", 128, 0.0, 0.5, "m")
    width = 2.4  # metres between nulls along azimuth: 24 samples
    along = torch.sinc((axes[0].values() - 51.2) / width)
    across = torch.sinc((axes[1].values() - 32.0) / 0.6)
    response = Signal((along[:, None] * across).to(torch.complex128), axes)
    cuts, measured = impulse_cuts(response, (51.2, 32.0)), impulse_response(response, (51.2, 32.0))
    for axis, spacing in (("azimuth", width), ("range", 0.6)):
        offset, line = cuts[axis]
        assert float(offset.min()) < -10.5 * spacing and float(offset.max()) > 10.5 * spacing
    offset, line = cuts["azimuth"]
    from_centre = float(measured["position_azimuth_m"]) - 51.2 + offset
    assert (line.abs() - torch.sinc(from_centre / width).abs()).abs().max() < 0.01


def test_a_cut_beside_a_stronger_point_does_not_warn(recwarn: pytest.WarningsRecorder) -> None:
    samples = torch.full((128, 64), 1e-3, dtype=torch.complex128)
    samples[40, 30], samples[49, 30] = 1, 3
    image = Signal(samples, (Axis("azimuth", 128, 0.0, 1.0, "m"), Axis("range", 64, 0.0, 1.0, "m")))
    assert len(impulse_cuts(image, (40.0, 30.0))) == 2 and not recwarn.list
    impulse_response(image, (40.0, 30.0))
    assert "no point response" in str(recwarn.list[0].message)


def test_interpolated_parts_agree_with_the_samples() -> None:
    n = 64
    spectrum = torch.zeros(n, dtype=torch.complex128)
    spectrum[:20] = torch.randn(20, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    line = torch.fft.ifft(torch.roll(spectrum, -10))
    torch.testing.assert_close(8 * finer(line, 8)[::8], line)
    axes = Axis("azimuth", 64, 0.0, 0.5, "m"), Axis("range", 48, 3.0, 0.25, "m")
    response = torch.sinc((axes[0].values() - 15.0) / 0.8)[:, None] * torch.sinc((axes[1].values() - 9.0) / 0.4)
    part = about_peak(Signal(response.to(torch.complex64), axes), (2.0, 1.0), 81)
    middle = [axis.start + 40 * axis.step for axis in part.axes]
    assert middle == pytest.approx([0.0, 0.0], abs=1e-9) and divmod(int(part.data.abs().argmax()), 81) == (40, 40)
    assert float(part.data[40, 40].real) == pytest.approx(1.0, abs=1e-5)


def test_an_image_is_rolled_to_where_another_one_lies() -> None:
    generator = torch.Generator().manual_seed(2)
    reference = image(64, 8)
    data = torch.zeros(64, 8, dtype=torch.complex64)
    data[10:14] = torch.randn(4, 8, dtype=torch.complex64, generator=generator)
    reference = reference.with_data(data)
    moved = rolled_to(reference.with_data(data.roll((57, 3), (0, 1))), reference)
    torch.testing.assert_close(moved.data, data)


# --- the report of a run


@pytest.fixture(scope="module")
def result(blank_pictures: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a velocity search, and one point far outside the strip."""
    folder = tmp_path_factory.mktemp("report")
    world = dict(TINY["world"]) | {"trials": 2}
    scene = world["scene"]["points"] | {"azimuth_m": [0.0, 9.0, 0.0], "range_m": [0.0, 40.0, 5000.0]}
    world["scene"] = {**world["scene"], "points": scene}
    stages = {"doppler": {"stage": "phase_increment"}}
    of_doppler = {"doppler_hz": "doppler.doppler_baseband_hz"}
    stages["velocity"] = {"stage": "effective_velocity", "uses": of_doppler, "lines": 64}
    focus = {"stage": "omega_k", "reference": "flat", "uses": of_doppler | {"velocity_m_s": "velocity"}}
    processor = {"clean": TINY["processor"]["clean"], "recommended": {"stages": stages | {"focus": focus}}}
    path = write_tiny(folder, world=world, processor=processor)
    assert main(["run", str(path), "--out", str(folder / "result")]) == 0
    return folder / "result"


def test_panels_wrap_in_one_container_a_picture(result: Path) -> None:
    page = (result / "report.html").read_text()
    rule = re.search(r"\.panels \{([^}]*)\}", page)
    assert rule and "display: flex" in rule.group(1) and "flex-wrap: wrap" in rule.group(1)
    lead, *figures = re.findall(r"<figure>(.*?)</figure>", page, re.DOTALL)
    assert 1 <= lead.count("<img") <= 2
    files = sorted(path.name for path in (result / "figures").iterdir())
    assert len(figures) == len({name.split("_")[0] for name in files})
    assert sum(figure.count("<img") for figure in figures) == len(files)
    assert all(figure.count('class="panels') == 1 and figure.count("<figcaption>") == 1 for figure in figures)
    assert any(figure.count("<img") > 1 for figure in figures)


def test_targets_outside_are_counted_and_named(result: Path) -> None:
    method = json.loads((result / "metrics.json").read_text())["methods"]["recommended"]
    assert len(method["targets_outside"]) == 1 and method["cases"]["all"]["targets_outside"] == 1
    page = (result / "report.html").read_text()
    assert f"Targets outside its image (1): {method['targets_outside'][0]}" in page
    assert "targets outside the image" in page


def test_the_curve_of_the_velocity_search_is_fine_about_the_estimate(
    result: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn = []
    curves = plot.curves
    monkeypatch.setattr(plot, "curves", lambda *args, **given: drawn.append(args) or curves(*args, **given))
    assert main(["run", str(result / "config.yaml"), "--out", str(tmp_path / "again")]) == 0
    (series, _, _, _, marks) = next(args for args in drawn if args[1].startswith("effective velocity"))
    velocity, entropy = series["entropy"]
    steps = np.diff(velocity)
    fine = 1.01 * np.median(steps)
    assert (steps <= fine).sum() >= 40 and steps.max() > 3 * fine
    assert np.abs(velocity - marks["estimate"]).min() < 1e-3 and np.isfinite(entropy).all()


def test_a_report_begins_with_the_images_before_and_after() -> None:
    curves = Picture(("c.png",), "Curves", "", ("",))
    shown = Picture(("1.png", "2.png", "3.png"), "Images", "text", ("ideal", "none, peak -9 dB", "recommended"))
    assert before_and_after([curves, shown], ["none", "other", "recommended"]) == Picture(
        ("2.png", "3.png"), "Before and after", "text"
    )
    assert before_and_after([shown], ["recommended"]) == Picture(("3.png",), "Before and after", "text")
    assert before_and_after([curves], ["none", "recommended"]) == curves
    assert before_and_after([Picture((), "A picture is missing", "")], ["recommended"]) is None
