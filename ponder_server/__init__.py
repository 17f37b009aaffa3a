"""Serving PONDER. Import this before torch's first matrix product, so that a row's bits do not depend on other rows.

MKL selects its kernels by shape, and with AVX-512 some of them sum in another order when one more robot is served: on
such a CPU test_batching, test_fleet and test_mtp fail by 7e-7. MKL's strict mode avoids this (Intel, "Conditional
Numerical Reproducibility"), at no measurable cost for products of PONDER's sizes.
"""

import os

os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")
