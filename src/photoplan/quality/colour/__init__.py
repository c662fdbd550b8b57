"""Lateral chromatic aberration: measured between bands, modelled over the field."""
