"""Fused operations of POUNCE's fast path in Triton, one a file, each beside its eager twin and their tolerance."""
