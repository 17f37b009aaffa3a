"""Fused operations of POUNCE's fast path in Triton, one per file, each beside its eager twin and their tolerance."""
