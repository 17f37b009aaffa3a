#!/usr/bin/env bash
# A trial to go on from the PONDER of note.sh, on two CPU cores: see docs/training.md, "Counts".
#
#     checkpoints/several/count.sh [OUT]    (the OUT of the other scripts)
#
# PONDER is asked for pace and count of what it is to stop. Of what note.sh has collected, the oracle's episodes. The same
# command goes on after a kill.
set -euo pipefail

out=${1:-out/several}
before=$out/note
next=$out/count
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

data=("$before/timed" "$before/timed" "$before/swaps" "$before/swaps" "$before/repick" "$before/shown" "$before/old" "$before/filled"
    "$before/imitated" "$before/highlight")

settle small_counting "$before/pair/ponder" "$before/pair/pounce" "$next" --data "${data[@]}" --sights "$before/sights"
evaluate "$next/pair" "$next"
