"""Reader of compensated phase history data (CPHD), NGA.STND.0068-1."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Recording, refuse_non_finite, unit_phasor
from torchsar.focus.chirp_z import chirp_z
from torchsar.io.extras import library, reading
from torchsar.radar import LIGHT_M_S, AntennaPath, InverseRadar, LocalFrame, geocentric, range_profiles
from torchsar.radar.spotlight import frequency_step_hz

# largest error of a frequency in steps that is ignored, by choice: 3e-4 rad at the swath's edge
_SAME_STEP = 1e-4
# largest error of a path in wavelengths by one antenna in place of two that is ignored, by choice
_SAME_ANTENNA = 1e-3
# shift of profiles in cells that is taken as rounding
_ZERO_SHIFT = 1e-9
# samples that are transformed at once, by choice: 64 MB as complex128
_BLOCK = 1 << 22
_POSITIONS = ("TxPos", "RcvPos", "SRPPos")
_NEEDED = ("TxTime", *_POSITIONS, "FX1", "FX2", "SC0", "SCSS")


def read_cphd(path: str | Path, dtype: torch.dtype = torch.complex64, channel: str | None = None) -> Recording:
    """Read a channel of a file of compensated phase history data (CPHD, versions 1.0.1 and 1.1.0).

    In the domain FX a sample at the frequency f has the phase SGN 2 pi f dt of a target whose echo
    arrives dt after that of the reference point (SRP) of its vector; in the domain TOA the peak of
    a target has the phase SGN 2 pi f_c dt, f_c the middle of FX1 and FX2. Both signs are accepted.
    Samples are multiplied by AmpSF, those of the domain FX beyond FX1 and FX2 are set to zero, as
    are vectors with SIGNAL = 0, and vectors without finite parameters are dropped. Vectors whose
    SC0 or SCSS differ are resampled to a common band (chirp-z, in the domain FX only). Delays by
    the troposphere and the ionosphere are taken as those of the reference point.

    Args:
        path: Path of the file.
        dtype: complex64 or complex128, dtype of the profiles.
        channel: Identifier of the channel; None for the reference channel of the file.

    Returns:
        Recording of range profiles as by `read_path`, in the frame east, north, up (`LocalFrame`)
        about the reference point of the scene (IARP). Side data are those of
        `AntennaPath.side_data` and `frequency_hz`; `origin_deg_m` (3,), latitude and longitude in
        degrees and height in metres of the IARP; `pulse_time_s` (pulse,), the times of transmission
        since the start of the collection; `scene_reference_m` (pulse, 3), the reference points;
        `scene_corners_m` (4, 3), the corners of the imaged area. Two antennas that the file calls
        monostatic become one in the middle between them where that changes no path over the area by
        more than a thousandth of a wavelength.

    Raises:
        ModuleNotFoundError: If sarkit is not installed (extra `formats`).
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged or of another kind, the channel does not exist, the
            samples are compressed, or vectors differ in a way that is not supported.
    """
    path = Path(path)
    sarkit = library("sarkit.cphd", "formats", f"reading {path}")
    with reading(path, "CPHD"), path.open("rb") as file:
        size = path.stat().st_size
        reader = sarkit.Reader(file)
        head = _Head(sarkit.XmlHelper(reader.metadata.xmltree), path, channel)
        head.refuse_cut_off(size)
        samples, vectors = reader.read_channel(head.channel)
        return _recording(head, samples, vectors, dtype, path)


class _Head:
    """Entries of the XML header of a file.

    Args:
        xml: Access to the XML by path.
        path: Path of the file, for messages.
        channel: Identifier of the channel; None for the reference channel.
    """

    def __init__(self, xml: Any, path: Path, channel: str | None) -> None:
        self._xml, self._path = xml, path
        known = [node.text for node in xml.element_tree.findall("{*}Data/{*}Channel/{*}Identifier")]
        self.channel: str = channel if channel is not None else self("Channel/RefChId")
        if self.channel not in known:
            raise ValueError(f"{path} has no channel {self.channel!r}; it has {known}")
        self.domain, self.sign = self("Global/DomainType"), int(self("Global/SGN"))
        if self.domain not in ("FX", "TOA") or self.sign not in (-1, 1):
            raise ValueError(
                f"{path} must have the domain FX or TOA and the sign +1 or -1, got {self.domain!r} and {self.sign}"
            )
        self.monostatic = self("CollectionID/CollectType") == "MONOSTATIC"

    def __call__(self, name: str) -> Any:
        """Value of an element; raise ValueError if there is none."""
        value = self._xml.load("/".join(f"{{*}}{part}" for part in name.split("/")))
        if value is None:
            raise ValueError(f"{self._path} lacks the element {name}")
        return value

    def refuse_cut_off(self, size: int) -> None:
        """Raise ValueError for compressed samples, or more of them than some bytes hold."""
        for node in self._xml.element_tree.findall("{*}Data/{*}Channel"):
            if node.findtext("{*}Identifier") == self.channel:
                if node.find("{*}CompressedSignalSize") is not None:
                    raise ValueError(
                        f"{self._path} holds compressed samples; decompress it with the tools of its producer"
                    )
                form = self("Data/SignalArrayFormat")
                counts = [int(node.findtext(f"{{*}}{key}")) for key in ("NumVectors", "NumSamples")]
                needed = counts[0] * (counts[1] * {"CI2": 2, "CI4": 4, "CF8": 8}[form] + int(self("Data/NumBytesPVP")))
                if not (min(counts) >= 2 and needed <= size):
                    raise ValueError(
                        f"{self._path} is cut off or damaged: {counts[0]} vectors of {counts[1]} samples {form} with "
                        f"their parameters take {needed} bytes, and the file has {size}"
                    )

    def corners_m(self, frame: LocalFrame) -> Tensor:
        """Corners of the imaged area at the height of the IARP, (4, 3)."""
        corners = torch.tensor(np.asarray(self("SceneCoordinates/ImageAreaCornerPoints"), float))
        height = torch.full((len(corners),), frame.height_m, dtype=torch.float64)
        return frame.local_m(geocentric(corners[:, 0], corners[:, 1], height))


def _recording(head: _Head, samples: np.ndarray, vectors: np.ndarray, dtype: torch.dtype, path: Path) -> Recording:
    """The recording of a channel."""
    finite = np.all([np.isfinite(vectors[name]).reshape(len(vectors), -1).all(-1) for name in _NEEDED], 0)
    if finite.sum() < 2:
        raise ValueError(f"{path} has {finite.sum()} vectors with finite parameters; an image needs two or more")
    if not finite.all():
        samples, vectors = samples[finite], vectors[finite]
    of = {name: torch.from_numpy(np.ascontiguousarray(vectors[name], "f8")) for name in _NEEDED}
    time = of["TxTime"]
    if not bool((time.diff() > 0).all()):
        raise ValueError(f"{path} must have rising times of transmission, got a least step of {time.diff().min():g} s")
    frame = LocalFrame(*np.asarray(head("SceneCoordinates/IARP/LLH"), float).tolist())
    transmitter, receiver, point = (frame.local_m(of[name]) for name in _POSITIONS)
    bands = (_Frequencies if head.domain == "FX" else _Delays)(samples.shape[-1], of, path)
    legs = [torch.linalg.vector_norm(place - point, dim=-1) for place in (transmitter, receiver)]
    reference = legs[0] + legs[1] + LIGHT_M_S * bands.shift_s
    corners = head.corners_m(frame)
    antennas = _antennas(transmitter, receiver, reference, point, corners, bands.frequency, head.monostatic)
    n, pulses = len(bands.frequency), len(time)
    step = frequency_step_hz(bands.frequency)
    radar = InverseRadar(
        carrier_hz=float(bands.frequency[n // 2]),
        bandwidth_hz=n * step,
        prf_hz=(pulses - 1) / float(time[-1] - time[0]),
        reference_range_m=float(antennas.reference_m.mean()) / 2,
    )
    scale = _scales(vectors)
    profiles = torch.empty(pulses, n, dtype=dtype)
    for first in range(0, pulses, block := max(1, _BLOCK // n)):
        rows = slice(first, first + block)
        history = torch.from_numpy(_complex(samples[rows]) * scale[rows, None])
        refuse_non_finite(history, f"{path}: samples")
        profiles[rows] = bands.profiles(history if head.sign < 0 else history.conj().resolve_conj(), rows).to(dtype)
    aux: dict[str, Any] = {
        "frequency_hz": bands.frequency,
        **antennas.side_data(),
        "origin_deg_m": torch.tensor([frame.latitude_deg, frame.longitude_deg, frame.height_m], dtype=torch.float64),
        "pulse_time_s": time,
        "scene_reference_m": point,
        "scene_corners_m": corners,
    }
    return Recording.from_arrays(profiles, radar, dtype=dtype, start_s=float(time[0]), what=str(path), **aux)


def _scales(vectors: np.ndarray) -> np.ndarray:
    """Factors of the samples of each vector."""
    names = vectors.dtype.names or ()
    scale = vectors["AmpSF"].astype("f8") if "AmpSF" in names else np.ones(len(vectors))
    return scale * (vectors["SIGNAL"] != 0) if "SIGNAL" in names else scale


def _complex(samples: np.ndarray) -> np.ndarray:
    """Samples of any format as complex128."""
    if samples.dtype.names:
        return samples["real"].astype("f8") + 1j * samples["imag"].astype("f8")
    return samples.astype("c16")


class _Frequencies:
    """Range profiles from vectors of the domain FX.

    Args:
        n: Number of samples of a vector.
        of: Parameters of the vectors.
        path: Path of the file, for messages.

    Attributes:
        frequency: Frequencies of the profiles in Hz.
        shift_s: Delay of the middle of the profiles relative to the reference point, in seconds.
    """

    def __init__(self, n: int, of: dict[str, Tensor], path: Path) -> None:
        start, step = self._start, self._step = of["SC0"], of["SCSS"]
        if not bool((step > 0).all() and (start > 0).all()):
            raise ValueError(
                f"{path} must have positive SC0 and SCSS, got a least SC0 of {start.min():g} and SCSS {step.min():g}"
            )
        self._ends = of["FX1"] - step / 2, of["FX2"] + step / 2
        self._k = torch.arange(n, dtype=torch.float64)
        self.shift_s = torch.zeros((), dtype=torch.float64)
        last = start + (n - 1) * step
        apart = max(float(v.max() - v.min()) for v in (start, last))
        self._alike = apart <= _SAME_STEP * float(step.min())
        if self._alike:
            self.frequency = start[0] + step[0] * self._k
            return
        wide, low, high = float(step.max()), float(start.min()), float(last.max())
        count = int(np.ceil((high - low) / wide)) + 1
        if count > 4 * n:
            raise ValueError(
                f"{path}: the bands of its vectors reach from {low:g} to {high:g} Hz, more than 4 times the band of "
                "one; split the file into groups of vectors of similar bands"
            )
        self.frequency = low + wide * torch.arange(count, dtype=torch.float64)

    def profiles(self, history: Tensor, rows: slice) -> Tensor:
        """Range profiles of some vectors.

        Args:
            history: Their samples, (vector, sample).
            rows: Numbers of the vectors.
        """
        start, step = self._start[rows, None], self._step[rows, None]
        f = start + step * self._k
        history = torch.where((f >= self._ends[0][rows, None]) & (f <= self._ends[1][rows, None]), history, 0)
        if self._alike:
            return range_profiles(history)
        n, count = len(self._k), len(self.frequency)
        wide = self.frequency[1] - self.frequency[0]
        middle, delay = count // 2, 1 / (count * wide)  # of cells, in seconds
        turns = (delay * step)[:, 0]
        found = chirp_z(history, middle * turns, -turns, count, centre=n // 2)
        cells = torch.arange(count, dtype=torch.float64) - middle
        shift = (start + n // 2 * step - self.frequency[middle]) * delay
        return found * unit_phasor(shift * cells, found.dtype) * (step / wide) / count**0.5


class _Delays:
    """Range profiles from vectors of the domain TOA.

    Cell m lies at the delay SC0 + m SCSS and has the phase of the carrier as in a range profile
    about the reference point; about its middle n // 2 the carrier turns by f_c times the delay.

    Args:
        n: Number of samples of a vector.
        of: Parameters of the vectors.
        path: Path of the file, for messages.

    Attributes:
        frequency: Frequencies of the profiles in Hz.
        shift_s: Delay of the middle of the profiles relative to the reference point, in seconds.
    """

    def __init__(self, n: int, of: dict[str, Tensor], path: Path) -> None:
        step, carrier = of["SCSS"], (of["FX1"] + of["FX2"]) / 2
        for name, value, scale in (("SCSS", step, step[0] / n), ("FX1 + FX2", carrier, 1 / (n * step[0]))):
            if not bool(step[0] > 0) or float((value - value[0]).abs().max()) > _SAME_STEP * float(scale):
                raise ValueError(
                    f"{path}: vectors of the domain TOA must share one positive SCSS and one FX1 + FX2, got {name} of "
                    f"{float(value.min()):.9g} to {float(value.max()):.9g}"
                )
        shift = of["SC0"] + n // 2 * step
        self.shift_s = torch.where(shift.abs() < _ZERO_SHIFT * step, 0, shift)
        self._turns = carrier[0] * self.shift_s
        self.frequency = carrier[0] + (torch.arange(n, dtype=torch.float64) - n // 2) / (n * step[0])

    def profiles(self, history: Tensor, rows: slice) -> Tensor:
        """Range profiles of some vectors.

        Args:
            history: Their samples, (vector, sample).
            rows: Numbers of the vectors.
        """
        return history * unit_phasor(self._turns[rows, None], history.dtype)


def _antennas(
    transmitter: Tensor,
    receiver: Tensor,
    reference: Tensor,
    point: Tensor,
    corners: Tensor,
    frequency: Tensor,
    monostatic: bool,
) -> AntennaPath:
    """The pair of antennas, or the one in their middle where that is as good over the scene."""
    pair = AntennaPath(transmitter, receiver, reference)
    if not monostatic:
        return pair
    middle = (transmitter + receiver) / 2
    apart = 2 * torch.linalg.vector_norm(middle - point, dim=-1) - torch.linalg.vector_norm(transmitter - point, dim=-1)
    one = AntennaPath(middle, None, reference + apart - torch.linalg.vector_norm(receiver - point, dim=-1))
    error = (one.path_m(corners) - pair.path_m(corners)).abs().max()
    return one if float(error * frequency[-1]) <= _SAME_ANTENNA * LIGHT_M_S else pair
