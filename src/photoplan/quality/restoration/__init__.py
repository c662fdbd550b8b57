"""Restoration: inverses of spread functions, filters designed and applied."""
