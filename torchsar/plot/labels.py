"""Labels of axes from names that end in their unit."""

from __future__ import annotations

# units by the last words of a name, the longest first
_UNITS = {
    "_per_s2": "1/s²",
    "_per_s": "1/s",
    "_rad_s": "rad/s",
    "_m_s2": "m/s²",
    "_m_s": "m/s",
    "_hz": "Hz",
    "_db": "dB",
    "_nats": "nats",
    "_rad": "rad",
    "_deg": "deg",
    "_m": "m",
    "_s": "s",
}
# words of names that are not written in small letters
_WRITTEN = "Doppler SNR PRF RMS RMSE IRW PSLR ISLR RCS SIR CNR SCR SCNR MFTA ADC"
_ACRONYMS = {word.lower(): word for word in _WRITTEN.split()}


def name_and_unit(name: str) -> tuple[str, str]:
    """Split the last part of a dotted name into words and unit.

    Args:
        name: Name with its unit, such as 'world.noise.snr_db'.

    Returns:
        Words and unit, such as ('SNR', 'dB').
    """
    last = name.rpartition(".")[2]
    suffix = next((suffix for suffix in _UNITS if last.endswith(suffix) and last != suffix), "")
    words = last.removesuffix(suffix).strip("_").split("_")
    return " ".join(_ACRONYMS.get(word, word) for word in words), _UNITS.get(suffix, "")


def axis_label(name: str) -> str:
    """Make the label of an axis from a name.

    Args:
        name: Name with its unit, such as 'doppler_error_hz'.

    Returns:
        Label such as 'Doppler error (Hz)'.
    """
    words, unit = name_and_unit(name)
    return f"{words} ({unit})" if unit else words
