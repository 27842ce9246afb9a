"""Small simulated recordings, one for each system, to try things out."""

from __future__ import annotations

import torch

from torchsar.core import Draws, Recording, Truth
from torchsar.data import Simulated

# Packaged config, case and overrides of the example of each system.
# The overrides reduce the size of the scene, or add noise so that errors remain to be found.
_EXAMPLES: dict[str, tuple[str, str | None, tuple[str, ...]]] = {
    "stripmap": (
        "stripmap_damaged",
        None,
        (
            *("world.lines=1024", "world.samples=1024", "world.beam.dwell_s=0.2", "radar.integration_s=0.2"),
            "world.scene.field.count=50",
        ),
    ),
    "isal": ("isal_table1", "sigma 2 pi", ("world.noise.snr_db=10",)),
    "isal_rotation": ("isal_rotation_snr", None, ("world.noise.snr_db=10",)),
    "sal": ("sal_points", "always lit, 20 dB", ()),
    "geo": ("geo_point_targets", None, ("world.samples=null", "world.pulses=900")),
    "geo_ocean": (
        "geo_ocean",
        None,
        (
            *("world.pulses=720", "world.samples=112", "world.targets.ship1.range_m=-200"),
            *("world.targets.ship2.range_m=0", "world.targets.ship3.range_m=150"),
        ),
    ),
    "path": ("path_autofocus", None, ("world.noise.snr_db=10",)),
}


def example(
    system: str, trials: int = 1, *, seed: int = 1, device: torch.device | str = "cpu"
) -> tuple[Recording, Truth]:
    """Simulate a small recording of a system, with errors and noise, and its true values.

        recording, truth = torchsar.datasets.example("stripmap")

    The scenes are reduced forms of packaged configs: an impaired strip of points (`stripmap`), a
    rotating aircraft with random start phases (`isal`), a satellite with non-uniform rotation
    (`isal_rotation`), three points under vibration (`sal`), four moving points, each in a trial of
    its own, in azimuth-only data of three channels (`geo`), ships on a sea (`geo_ocean`), and
    points seen from an aircraft with errors of navigation (`path`). `torchsar.data.Simulated`
    simulates any config.

    Args:
        system: Name of the system, such as "isal".
        trials: Number of trials, the first dimension of the samples; they have different noise
            and different random errors. Of `geo` the dimension is four times as long.
        seed: Seed of all random numbers.
        device: Device of the result.

    Returns:
        The recording, and its truth with the recording without impairments (`clean`).

    Raises:
        ValueError: If there is no such system, or the number of trials or the device is not
            accepted.
        ImportError: If a package of the extra `study` is not installed.
    """
    if system not in _EXAMPLES:
        raise ValueError(f"there is no example of a system {system!r}; choose one of {', '.join(_EXAMPLES)}")
    config, case, overrides = _EXAMPLES[system]
    draws = Draws(seed, trials=range(trials))
    return next(iter(Simulated(config, draws, batch=max(trials, 1), overrides=overrides, case=case, device=device)))
