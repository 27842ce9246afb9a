"""Image quality, errors of estimates, and Cramer-Rao bounds.

=================================  =================================================================
to judge                           what to use
=================================  =================================================================
any of these, ending a chain       `Measure`
sharpness of an image              `entropy`, `contrast`
image against a reference          `error_db`; with a free gain `error_after_gain_db`, with a shift
                                   `registered_error_db`, `registered_errors`; `correlation`
response of a point                `impulse_response`; in an azimuth profile `azimuth_response`
false targets of several channels  `replica_level` within `replica_zones`
phases of pulses                   `phase_rmse`, `residual_phase`, `strehl`; bounds
                                   `pulse_phase_bound_rad`, `pulse_phase_bound_of_scene_rad`
errors over trials                 `trial_statistics`, with confidence intervals
bound of a Doppler centroid        `beam_centre_bound_hz`, of a tone `tone_frequency_bound_hz`;
                                   published curve `reference_doppler_std_hz`
bound of the velocity of a strip   `velocity_bound_m_s`
bounds of a moving point           `bistatic_bounds`
bounds of a non-uniform rotation   `rotation_bounds`
bound of a velocity by a ladar     `velocity_free_offset_bound_m_s`,
                                   `velocity_known_offset_bound_m_s`, `velocity_segmented_bound_m_s`
bound of a range by a ladar        `range_per_sweep_bound_m`, `integrated_range_detrended_bound_m`
bound of the errors of a path      `line_of_sight_bound_m`
=================================  =================================================================
"""

from torchsar.core.kinds import check_kinds
from torchsar.metrics.bistatic_bounds import bistatic_bounds
from torchsar.metrics.bounds import (
    beam_centre_bound_hz,
    pulse_phase_bound_of_scene_rad,
    pulse_phase_bound_rad,
    reference_doppler_std_hz,
    tone_frequency_bound_hz,
    velocity_bound_m_s,
)
from torchsar.metrics.image import contrast, correlation, entropy, error_after_gain_db, error_db
from torchsar.metrics.impulse import impulse_response
from torchsar.metrics.intervals import trial_statistics
from torchsar.metrics.ladar_bounds import (
    integrated_range_detrended_bound_m,
    range_per_sweep_bound_m,
    velocity_free_offset_bound_m_s,
    velocity_known_offset_bound_m_s,
    velocity_segmented_bound_m_s,
)
from torchsar.metrics.measure import Measure
from torchsar.metrics.path_bounds import line_of_sight_bound_m
from torchsar.metrics.phase import phase_rmse, residual_phase, strehl
from torchsar.metrics.registration import registered_error_db, registered_errors
from torchsar.metrics.replicas import azimuth_response, replica_level, replica_zones
from torchsar.metrics.rotation_bounds import rotation_bounds

__all__ = [
    "Measure",
    "azimuth_response",
    "beam_centre_bound_hz",
    "bistatic_bounds",
    "contrast",
    "correlation",
    "entropy",
    "error_after_gain_db",
    "error_db",
    "impulse_response",
    "integrated_range_detrended_bound_m",
    "line_of_sight_bound_m",
    "phase_rmse",
    "pulse_phase_bound_of_scene_rad",
    "pulse_phase_bound_rad",
    "range_per_sweep_bound_m",
    "reference_doppler_std_hz",
    "registered_error_db",
    "registered_errors",
    "replica_level",
    "replica_zones",
    "residual_phase",
    "rotation_bounds",
    "strehl",
    "tone_frequency_bound_hz",
    "trial_statistics",
    "velocity_bound_m_s",
    "velocity_free_offset_bound_m_s",
    "velocity_known_offset_bound_m_s",
    "velocity_segmented_bound_m_s",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
