"""Correction of impaired raw data.

A line is the record of one pulse along range.

==================================  ================================================================
impairment                          what to use
==================================  ================================================================
line numbers, irregular lines       `line_integrity`, first of all; `regular_lines` of a recording
                                    whose numbers, times or window starts are right
missing lines                       `sparse_fill`; faster and less exact `band_limited_fill`,
                                    `linear_fill`, `zero_fill`
constant, drift, ground at rest     `remove_constant`, before any estimator
spurs                               `remove_tones`
unequal I and Q                     `balance_quadrature`, after `remove_constant`
narrowband interference             `subtract_interference`; `notch_interference`;
                                    `drop_interference` with a fill after it
pulses of another radar             `remove_pulses`
sampling jitter, with a pilot tone  `estimate_jitter_pilot`, then `correct_jitter`
sampling jitter, without a pilot    `estimate_jitter_blind`, then `correct_jitter` (by
                                    `BandLimited`; faster `Lagrange`)
response of the receiver            `estimate_response_sharpest` or `estimate_response_points`; the
                                    amplitude too `EstimateFlatResponse`; then `correct_response`
channels that record lines in turn  `estimate_imbalance`, then `correct_imbalance`
continuous record of a ladar        `SplitSweeps`, with `find_trigger` where the start is not known;
                                    `blank_turning_points`; as published `circular_shift`
non-linear sweeps of a ladar        `calibrate_sweeps`
==================================  ================================================================

Most functions are stages of chains, too: `SparseFill` calls `sparse_fill`, and so on. `PilotJitter`
and `BlindJitter` are the stages of the estimators of jitter, and `EstimateResponse` is that of both
functions for the response.
"""

from torchsar.core.kinds import check_kinds
from torchsar.repair.fill import (
    BandLimitedFill,
    LinearFill,
    SparseFill,
    ZeroFill,
    band_limited_fill,
    linear_fill,
    zero_fill,
)
from torchsar.repair.interference import (
    DropInterference,
    NotchInterference,
    RemovePulses,
    SubtractInterference,
    drop_interference,
    notch_interference,
    remove_pulses,
    subtract_interference,
)
from torchsar.repair.jitter import (
    BandLimited,
    CorrectJitter,
    Lagrange,
    correct_jitter,
)
from torchsar.repair.jitter_blind import BlindJitter, PilotJitter, estimate_jitter_blind, estimate_jitter_pilot
from torchsar.repair.lines import LineIntegrity, line_integrity
from torchsar.repair.placing import regular_lines
from torchsar.repair.receiver import (
    BalanceQuadrature,
    CorrectImbalance,
    EstimateImbalance,
    RemoveConstant,
    RemoveTones,
    balance_quadrature,
    correct_imbalance,
    estimate_imbalance,
    remove_constant,
    remove_tones,
)
from torchsar.repair.response import CorrectResponse, correct_response
from torchsar.repair.response_phase import (
    EstimateFlatResponse,
    EstimateResponse,
    estimate_response_points,
    estimate_response_sharpest,
)
from torchsar.repair.sparse import sparse_fill
from torchsar.repair.triangle import (
    BlankTurningPoints,
    CircularShift,
    SplitSweeps,
    blank_turning_points,
    circular_shift,
)
from torchsar.repair.triangle_calibrate import CalibrateSweeps, calibrate_sweeps
from torchsar.repair.trigger import find_trigger

__all__ = [
    "BalanceQuadrature",
    "BandLimited",
    "BandLimitedFill",
    "BlankTurningPoints",
    "BlindJitter",
    "CalibrateSweeps",
    "CircularShift",
    "CorrectImbalance",
    "CorrectJitter",
    "CorrectResponse",
    "DropInterference",
    "EstimateFlatResponse",
    "EstimateImbalance",
    "EstimateResponse",
    "Lagrange",
    "LineIntegrity",
    "LinearFill",
    "NotchInterference",
    "PilotJitter",
    "RemoveConstant",
    "RemovePulses",
    "RemoveTones",
    "SparseFill",
    "SplitSweeps",
    "SubtractInterference",
    "ZeroFill",
    "balance_quadrature",
    "band_limited_fill",
    "blank_turning_points",
    "calibrate_sweeps",
    "circular_shift",
    "correct_imbalance",
    "correct_jitter",
    "correct_response",
    "drop_interference",
    "estimate_imbalance",
    "estimate_jitter_blind",
    "estimate_jitter_pilot",
    "estimate_response_points",
    "estimate_response_sharpest",
    "find_trigger",
    "line_integrity",
    "linear_fill",
    "notch_interference",
    "regular_lines",
    "remove_constant",
    "remove_pulses",
    "remove_tones",
    "sparse_fill",
    "subtract_interference",
    "zero_fill",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
