"""Motion logs: columns by their names and units, dates, latitudes, records that are missing."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from torchsar import Draws, echo, focus, radar, scene
from torchsar.radar import geocentric, read_track

TIME = np.arange(8) / 4
PLACE = np.stack([-300 + 0 * TIME, 20 * TIME - 20, 100 + TIME**2], -1)
LOGS = {
    "names": ("time_s,x,y,z", ",", [TIME, *PLACE.T]),
    "a comment, tabs": ("# T\tEast\tNorth\tUp", "\t", [TIME, *PLACE.T]),
    "blanks without names": ("", " ", [TIME, *PLACE.T]),
    "units and order": (
        "roll;z (km);y_cm;x[m];gps_time_ms",
        ";",
        [0 * TIME, PLACE[:, 2] / 1e3, PLACE[:, 1] * 100, PLACE[:, 0], 1e3 * TIME],
    ),
}


def written(path: Path, header: str, mark: str, columns: list[np.ndarray]) -> Path:
    rows = (mark.join(f"{x:.12g}" for x in row) for row in np.stack(columns, -1))
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n")
    return path


@pytest.mark.parametrize("log", LOGS)
def test_columns_by_name_and_unit(tmp_path: Path, log: str) -> None:
    track = read_track(written(tmp_path / "log.csv", *LOGS[log]), origin=(0.0, 0.0, 100.0))
    torch.testing.assert_close(track.time_s, torch.from_numpy(TIME))
    torch.testing.assert_close(track.position_m, torch.from_numpy(PLACE - [0, 0, 100]), rtol=1e-9, atol=1e-9)


def test_numpy_archives_and_dates(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", t=TIME, x=PLACE[:, 0], y=PLACE[:, 1], z=PLACE[:, 2])
    np.save(tmp_path / "log.npy", np.stack([TIME, *PLACE.T], -1))
    dates = np.datetime64("2024-05-17T10:00:00") + (1e3 * TIME).astype("timedelta64[ms]")
    rows = [f"{date}Z,{x},{y},{z}" for date, (x, y, z) in zip(dates, PLACE.tolist(), strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(["utc,x,y,z", *rows]))
    for name in ("log.npz", "log.npy", "log.csv"):
        track = read_track(tmp_path / name)
        torch.testing.assert_close(track.position_m, torch.from_numpy(PLACE))
        torch.testing.assert_close(track.time_s - track.time_s[0], torch.from_numpy(TIME), rtol=0, atol=1e-6)


def test_decimal_commas(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t;x;y;z\n0;1,5;2;3\n0,5;-1,25;2;3\n")
    assert read_track(tmp_path / "log.csv").position_m[:, 0].tolist() == [1.5, -1.25]


def test_times_of_a_day(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,x,y,z\n10:15:30.05,1,2,3\n10:16:00,1,2,3\n")
    assert read_track(tmp_path / "log.csv").time_s.tolist() == [36930.05, 36960.0]


def test_a_missing_origin_of_latitudes_is_named(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,lat,lon,alt\n0,48,11,500\n1,48.001,11,500\n")
    with pytest.warns(
        UserWarning, match="no origin is given, and the scene is taken to lie at height 0 under the first"
    ):
        assert abs(float(read_track(tmp_path / "log.csv").position_m[0, 2]) - 500) < 1e-6


def test_latitudes_become_local_and_records_with_nan_are_named(tmp_path: Path) -> None:
    latitude, longitude, height = 48 + 1e-4 * TIME, 11 + 0 * TIME, 500 + 0 * TIME
    height[[2, 5]] = np.nan
    path = written(tmp_path / "gps.csv", "timestamp,Latitude,Lon_deg,alt_m", ",", [TIME, latitude, longitude, height])
    with pytest.warns(UserWarning, match=r"gps.csv: 2 of 8 records hold NaN and are left out: 3, 6"):
        track = read_track(path, origin=(48.0, 11.0, 480.0))
    assert track.frame is not None and track.time_s.tolist() == np.delete(TIME, [2, 5]).tolist()
    earth = geocentric(*(torch.from_numpy(np.delete(x, [2, 5])) for x in (latitude, longitude, 500 + 0 * TIME)))
    torch.testing.assert_close(track.frame.geocentric_m(track.position_m), earth, rtol=0, atol=1e-6)
    assert abs(float(track.position_m[0, 2]) - 20) < 1e-6


MISTAKES = {
    "columns": ("time,x,y", [TIME, TIME, TIME], "must hold columns of one length with time and x, y, z"),
    "times": ("time,x,y,z", [TIME[::-1], *PLACE.T], "times rise, got 8, and 1.5 s after 1.75 s; sort them"),
    "a record twice": (
        "time,x,y,z",
        [TIME[[0, 1, 1, 2]], *PLACE[[0, 1, 1, 2]].T],
        "0.25 s after 0.25 s; remove the repeated record",
    ),
    "scaled latitude": ("t,lat,lon,alt", [TIME, 48e7 + TIME, 11e7 + TIME, TIME], "whether they are scaled by 1e7"),
    "text": ("t,x,y,z\n1,2,3,4\n1,2,three,4", [TIME, *PLACE.T], "row 3 is no row of numbers: '1,2,three,4'"),
    "a name twice": ("t,x,y,x", [TIME, *PLACE.T], "several columns have the name 'x'; give each a name of its own"),
    "a short row": ("t,x,y,z\n1,2,3", [TIME, *PLACE.T], "row 3 has 4 numbers, and others have 3"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence(tmp_path: Path, mistake: str) -> None:
    header, columns, said = MISTAKES[mistake]
    with pytest.raises(ValueError) as error:
        read_track(written(tmp_path / "log.csv", header, ",", columns))
    assert str(error.value).startswith(str(tmp_path / "log.csv")) and said in str(error.value), error.value


def test_a_simulation_flies_along_a_log(tmp_path: Path) -> None:
    log = read_track(written(tmp_path / "log.csv", *LOGS["names"]))
    flight = scene.Flight(scene.RecordedPath(log, start_s=0.25))
    at = torch.arange(40, dtype=torch.float64) / 40
    expected = torch.stack([0 * at - 300, 20 * (at + 0.25) - 20, 100 + (at + 0.25) ** 2], -1)
    torch.testing.assert_close(flight.position_m(at), expected, rtol=0, atol=1e-9)
    sensor = radar.InverseRadar(carrier_hz=9.6e9, bandwidth_hz=160e6, prf_hz=40.0)
    recording, _ = echo.simulate_path(sensor, scene.PathWorld(scene.Points([1.0], [2.0]), flight), 40, 16, Draws(1))
    image = focus.SpotlightImage(recording.aux, 8.0, 8.0, 0.5)(recording.signal)
    peak = divmod(int(image.data.abs().argmax()), 17)
    assert [float(axis.values()[i]) for axis, i in zip(image.axes, peak, strict=True)] == pytest.approx(
        [1, 2], abs=0.51
    )
    with pytest.raises(ValueError, match=r"pulses must lie within the navigation record"):
        flight.position_m(at + 2)


def test_a_flight_takes_a_path_only() -> None:
    with pytest.raises(
        TypeError, match=r"nominal must be an object with position_m\(time_s\), such as Str.*got 'log.csv'"
    ):
        scene.Flight("log.csv")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "header",
    [
        "GPS Time (s),Latitude (deg),Longitude (deg),Ellipsoidal height (m)",
        "utc_time,lat,lon,altitude_msl",
        "time(seconds),latitude(degrees),longitude(degrees),height(meters)",
    ],
)
def test_headers_of_instruments(tmp_path: Path, header: str) -> None:
    (tmp_path / "log.csv").write_text(f"{header}\n0,48,11,500\n1,48.001,11,500\n")
    track = read_track(tmp_path / "log.csv", origin=(48.0, 11.0, 450.0))
    assert track.time_s.tolist() == [0.0, 1.0] and track.position_m[1].tolist() == pytest.approx(
        [0, 111.2, 50], abs=0.1
    )


def test_milliseconds_in_a_word(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time(millisecond),x,y,z\n0,1,2,3\n500,1,2,3\n")
    assert read_track(tmp_path / "log.csv").time_s.tolist() == [0.0, 0.5]


def test_doubtful_degrees_without_names_are_named(tmp_path: Path) -> None:
    path = tmp_path / "boat.txt"
    time = np.arange(100.0)
    np.savetxt(path, np.stack([time, 48 + 1e-4 * time, 11 + 0 * time, 0.5 + 0 * time], -1), fmt="%.8f")
    with pytest.warns(UserWarning, match=r"is read as time, x, y, z in metres, which move by 0.0099 m in 99 s; if"):
        assert read_track(path).frame is None
    np.savetxt(path, np.stack([time, 0.1 * time, 0 * time, 2 + 0 * time], -1))  # a rail
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_track(path)


def test_degrees_without_names_are_no_metres(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("0,48.0,11.0,500\n1,48.001,11.0,500\n")
    with pytest.raises(ValueError, match=r"no line of names, and columns 2 and 3 \(48, 11\) hardly change"):
        read_track(tmp_path / "log.csv")


def test_an_unknown_column_is_named_with_the_known_names(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,lat,lon,level\n0,48,11,500\n1,48.001,11,500\n")
    with pytest.raises(ValueError, match=r"got .*level \(2\).*height may be called h, height, alt, altitude, ell"):
        read_track(tmp_path / "log.csv")
