"""Foundation of the package: axes, signals, chains, estimates, random draws and transforms."""

from torchsar.core.alternate import Alternate, Turn
from torchsar.core.axis import Axis
from torchsar.core.chain import Chain, Trace, Use, use
from torchsar.core.check import checked_samples, level_of, refuse_non_finite, refuse_non_finite_values, unit_level
from torchsar.core.draws import Draws
from torchsar.core.estimate import Estimate, settle
from torchsar.core.fft import (
    block_bytes_of,
    centred_fft,
    centred_ifft,
    fft_lines,
    from_frequency,
    over_blocks,
    spectrum_in_blocks,
    to_frequency,
    transform_in_blocks,
)
from torchsar.core.memory import PeakMemory, keep_freed_memory, machine_memory_bytes
from torchsar.core.phase import cis, linear_phasor, outer_phasor, phasor_tables, real_dtype, reduced_turns, unit_phasor
from torchsar.core.polynomials import legendre
from torchsar.core.select import best_of, per_trial, take
from torchsar.core.signal import Recording, Signal, Truth
from torchsar.core.spline import UniformSpline
from torchsar.core.stage import Stage
from torchsar.core.stored import ArrayFile, StoredArray

__all__ = [
    "Alternate",
    "ArrayFile",
    "Axis",
    "Chain",
    "Draws",
    "Estimate",
    "PeakMemory",
    "Recording",
    "Signal",
    "Stage",
    "StoredArray",
    "Trace",
    "Truth",
    "Turn",
    "UniformSpline",
    "Use",
    "best_of",
    "block_bytes_of",
    "centred_fft",
    "centred_ifft",
    "checked_samples",
    "cis",
    "fft_lines",
    "from_frequency",
    "keep_freed_memory",
    "legendre",
    "level_of",
    "linear_phasor",
    "machine_memory_bytes",
    "outer_phasor",
    "over_blocks",
    "per_trial",
    "phasor_tables",
    "real_dtype",
    "reduced_turns",
    "refuse_non_finite",
    "refuse_non_finite_values",
    "settle",
    "spectrum_in_blocks",
    "take",
    "to_frequency",
    "transform_in_blocks",
    "unit_level",
    "unit_phasor",
    "use",
]
