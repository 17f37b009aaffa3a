"""Serving POUNCE. Import this before torch's first matrix product, so that chunks do not depend on the process.

`ponder_server` sets MKL's strict mode, which in a shared process applies to POUNCE too. Without it here, POUNCE would
round differently in its own process, or in an episode without PONDER.
"""

import os

os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")
