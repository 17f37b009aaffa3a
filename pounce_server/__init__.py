"""Serving POUNCE. Importing this before torch's first product makes a chunk the same whatever shares its process.

`ponder_server` asks MKL for its strict mode, for a reason of its own, and in one process POUNCE gets it too. Without it
here, a process of its own would round otherwise, and so would an episode in which PONDER is not loaded.
"""

import os

os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")
