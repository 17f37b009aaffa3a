"""Triton kernels that both servers use, and how kernels are launched. Without Triton their eager twins run."""
