"""The noise budget of a sensor in electrons (Behr 1989, §3.6.4 and table 3.3, after Beynon)."""

from __future__ import annotations

from dataclasses import dataclass
from math import log2, log10, sqrt

from photoplan.errors import InputError

#: By how many kelvin the dark current doubles (Behr 1989, §3.6.4).
DOUBLING_C = 10.0


def transfer_noise(signal_e: float, inefficiency: float, transfers: float) -> float:
    """Noise of shifting charges, electrons: √(2 ε n N) (Behr 1989, §3.6.4)."""
    return sqrt(2.0 * inefficiency * transfers * signal_e)


def amplifier_noise(capacitance_pf: float) -> float:
    """Noise of resetting the output capacitance, electrons: 400 √C (Behr 1989, table 3.3)."""
    return 400.0 * sqrt(capacitance_pf)


def dark_at(current: float, temperature_c: float, reference_c: float, doubling_c: float = DOUBLING_C) -> float:
    """Dark current at a temperature from that at another one; it doubles every `doubling_c` (Behr 1989, §3.6.4)."""
    return float(current * 2.0 ** ((temperature_c - reference_c) / doubling_c))


@dataclass(frozen=True)
class NoiseBudget:
    """Sources of noise of one reading, electrons; None where a source is not described."""

    signal_e: float
    """Electrons of the signal."""
    dark_e: float | None = None
    """Electrons of the dark current."""
    transfer: float | None = None
    """Noise of shifting charges."""
    amplifier: float | None = None
    """Noise of the amplifier, or all noise of reading."""
    quantisation: float | None = None
    """Noise of rounding to grey values."""

    def __post_init__(self) -> None:
        if not self.signal_e > 0.0:
            raise InputError(f"a signal of {self.signal_e:g} electrons; it is positive")

    @property
    def shot(self) -> float:
        """Noise of the light: √N."""
        return sqrt(self.signal_e)

    @property
    def dark(self) -> float | None:
        """Noise of the dark current: √N."""
        return None if self.dark_e is None else sqrt(self.dark_e)

    def sources(self) -> dict[str, float]:
        """Noise of each described source, electrons."""
        every = {
            "shot": self.shot,
            "dark": self.dark,
            "transfer": self.transfer,
            "amplifier": self.amplifier,
            "quantisation": self.quantisation,
        }
        return {name: value for name, value in every.items() if value is not None}

    @property
    def total(self) -> float:
        """Root of the sum of squares: the sources are independent."""
        return sqrt(sum(value**2 for value in self.sources().values()))

    @property
    def plain_sum(self) -> float:
        """Sum of the sources, an upper bound; the total that Behr 1989, table 3.3 prints."""
        return sum(self.sources().values())

    @property
    def without_signal(self) -> float:
        """Noise that stays without light: the root of the sum of squares of dark, amplifier and quantisation."""
        left = {name: v for name, v in self.sources().items() if name in ("dark", "amplifier", "quantisation")}
        return sqrt(sum(value**2 for value in left.values()))

    @property
    def signal_to_noise(self) -> float:
        """Signal through total noise."""
        return self.signal_e / self.total

    @property
    def signal_to_noise_db(self) -> float:
        """The same in decibels: 20 log10."""
        return 20.0 * log10(self.signal_to_noise)

    @property
    def signal_to_noise_bits(self) -> float:
        """The same in bits: log2."""
        return log2(self.signal_to_noise)
