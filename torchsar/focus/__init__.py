"""Range compression and image formation."""

from torchsar.focus.nufft import Nufft, nufft_type1, nufft_type2
from torchsar.focus.omega_k import OmegaK, StoredOmegaK, omega_k
from torchsar.focus.reference import RangeCompress, flat_reference, matched_reference, range_compress
from torchsar.focus.stolt import OmegaKStolt, omega_k_stolt

__all__ = ["Nufft", "OmegaK", "OmegaKStolt", "RangeCompress", "StoredOmegaK", "flat_reference", "matched_reference", "nufft_type1", "nufft_type2", "omega_k", "omega_k_stolt", "range_compress"]
