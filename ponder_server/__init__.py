"""Serving PONDER. Importing this before torch's first product keeps a row's bits apart from how many rows there are.

MKL picks its kernels by shape, and with AVX-512 some sum in another order when a robot more is served: on such a CPU
the laws of test_batching, test_fleet and test_mtp failed by 7e-7. Its strict mode does not (Intel, "Conditional
Numerical Reproducibility"); on products of PONDER's sizes it costs nothing that could be measured.
"""

import os

os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")
