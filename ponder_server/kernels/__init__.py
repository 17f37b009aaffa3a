"""Fused operations of a short append, each beside the eager twin that it must agree with."""
