"""Rigs with faults, for `tools/real_errors.py`."""
