"""Foundation of the package: axes, signals, chains, estimates, random draws and transforms.

=======================================  ==========================================================
data or task                             what to use
=======================================  ==========================================================
samples with named axes                  `Signal` and `Axis`; dimensions before the axes are trials
record of an instrument                  `Recording`: the signal, the instrument and side data
true values of a simulation              `Truth`
processing step of your own              `Stage`
several steps in order                   `Chain`; `use` passes a value to a later step; `Trace`
                                         holds all results, and `Spread` their uncertainty
several effects, each estimated in turn  `Alternate` with one `Turn` for each
result of an estimator                   `Estimate`; `Outcome` says whether it can be trusted,
                                         `counts` and `worst` combine outcomes
random numbers that can be repeated      `Draws`
spectrum along an axis of a signal       `to_frequency` and `from_frequency`
spectrum of a tensor                     `centred_fft` and `centred_ifft`
exp(j phase)                             `cis` in radians, `unit_phasor` in turns, `linear_phasor`
                                         for a linear phase
phase without whole turns                `wrapped`, in turns `reduced_turns`
smooth curve                             `Spline` through knots, `legendre` polynomials
one value or index per trial             `per_trial` to broadcast it, `take` to select by it
power, very large or small samples       `power_of`, `unit_level`, `level_of`
checks in a function of your own         `checked_samples`, `refuse_non_finite`, `check_value`;
                                         `gathered_checks` and `host_value` on an accelerator
whether a device can compute             `device_fault`
a derivative that does not exist         `DerivativeWarning`
=======================================  ==========================================================
"""

from torchsar.core import trees as trees  # registers signals and estimates with torch
from torchsar.core.alternate import Alternate, Turn
from torchsar.core.chain import Chain
from torchsar.core.connect import Use, use
from torchsar.core.derivatives import DerivativeWarning, differentiable
from torchsar.core.draws import Draws, Source
from torchsar.core.estimate import Estimate, Outcome, counts, settle, worst
from torchsar.core.fft import (
    block_bytes_of,
    centred_fft,
    centred_ifft,
    fft_lines,
    from_frequency,
    is_plain,
    over_blocks,
    to_frequency,
    transform_in_blocks,
)
from torchsar.core.host import (
    check_value,
    checked_samples,
    device_fault,
    gathered_checks,
    host_largest,
    host_value,
    host_values,
    is_hidden,
    is_out_of_memory,
    is_traced,
    level_of,
    power_of,
    refuse_non_finite,
    refuse_non_finite_values,
    unit_level,
    untraced,
)
from torchsar.core.linear import cholesky_factor, linear_solve, matrix_inverse
from torchsar.core.phase import (
    cis,
    linear_phasor,
    outer_phasor,
    phasor_tables,
    real_dtype,
    reduced_turns,
    unit_phasor,
    wrapped,
)
from torchsar.core.select import best_of, numbers_on, per_trial, take, true_positions
from torchsar.core.signal import Axis, Recording, Signal, Truth
from torchsar.core.spline import Spline, legendre
from torchsar.core.spread import Spread
from torchsar.core.stage import Stage
from torchsar.core.stored import ArrayFile, StoredArray
from torchsar.core.trace import Trace

__all__ = [
    "Alternate",
    "Axis",
    "Chain",
    "Draws",
    "Estimate",
    "Outcome",
    "Recording",
    "Signal",
    "Source",
    "Spline",
    "Spread",
    "Stage",
    "Trace",
    "Truth",
    "Turn",
    "Use",
    "centred_fft",
    "centred_ifft",
    "check_value",
    "checked_samples",
    "cis",
    "counts",
    "device_fault",
    "from_frequency",
    "gathered_checks",
    "host_value",
    "legendre",
    "level_of",
    "linear_phasor",
    "per_trial",
    "power_of",
    "real_dtype",
    "reduced_turns",
    "refuse_non_finite",
    "take",
    "to_frequency",
    "unit_level",
    "unit_phasor",
    "use",
    "worst",
    "wrapped",
]
__dir__ = __all__.copy
