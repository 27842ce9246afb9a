"""The chain that focuses points of known velocity and position."""

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
    """Build the chain from channels to the images of points, each of known motion.

    The chain takes `given.u_r_m_s`, `u_a_m_s`, `y0_m` and `range_m` alike, shape (row,).

    Args:
        radar: Instrument.
        rebuild: Reconstruction of the Doppler bands.
        bandwidth_hz: Doppler band that is focused; None for the whole one.
        migration: Correction of range migration; None for azimuth-only data.
        order: Orders of the transmit range that are removed; None for all.
        full: Whether the data are chirps that must be compressed first.
        follow: Whether the migration is corrected with the known motion.

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
