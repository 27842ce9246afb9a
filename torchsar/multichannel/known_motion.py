"""Chain of stages that focuses points of known velocity and position."""

from __future__ import annotations

from torch import nn

from torchsar.core import Chain, use
from torchsar.multichannel.azimuth import FocusAzimuth
from torchsar.multichannel.compress import CompressChannels
from torchsar.multichannel.migration import CorrectMigration, Migration
from torchsar.multichannel.reconstruct import Rebuild, Reconstruct
from torchsar.multichannel.transmit import RemoveTransmitRange
from torchsar.radar import BistaticRadar


def known_motion_chain(
    radar: BistaticRadar,
    rebuild: Rebuild,
    bandwidth_hz: float | None = None,
    migration: Migration | None = None,
    order: int | None = None,
    full: bool = False,
    follow: bool = True,
) -> Chain:
    """Build the chain of stages from channels to the images of points of known motion.

    When it is run, the chain needs the motion of each point by the names `given.u_r_m_s`,
    `given.u_a_m_s`, `given.y0_m` and `given.range_m`, each of shape (trial,): slant-range and
    along-track speed in m/s, along-track position and closest range in metres.

    Args:
        radar: Radar parameters.
        rebuild: Reconstruction of the Doppler bands.
        bandwidth_hz: Width of the Doppler band that is focused in Hz; None for the whole
            reconstructed band.
        migration: Correction of range migration; None for azimuth-only data.
        order: Highest power of slow time in the transmit range that is removed from the phase; None
            for all.
        full: Whether the data are full chirps, which are then compressed in range first.
        follow: Whether the migration is corrected with the known motion, instead of that of a point
            at rest.

    Returns:
        The chain.
    """
    known = {name: f"given.{name}" for name in ("u_r_m_s", "u_a_m_s", "y0_m")}
    stages: dict[str, nn.Module] = {"compress": CompressChannels(radar, "flat")} if full else {}
    stages["remove"] = RemoveTransmitRange(radar, order)
    if migration is not None:
        stages["correct"] = use(CorrectMigration(radar, migration), **(known if follow else {}))
    stages["rebuild"] = use(Reconstruct(radar, rebuild), **known)
    stages["focus"] = use(FocusAzimuth(radar, bandwidth_hz), **known, range_m="given.range_m")
    return Chain(**stages)
