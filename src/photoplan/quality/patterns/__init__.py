"""Test patterns: bars, Siemens stars and USAF targets."""
