"""Range compression and image formation."""

from torchsar.focus.omega_k import OmegaK, StoredOmegaK, omega_k
from torchsar.focus.reference import RangeCompress, flat_reference, matched_reference, range_compress

__all__ = ["OmegaK", "RangeCompress", "StoredOmegaK", "flat_reference", "matched_reference", "omega_k", "range_compress"]
