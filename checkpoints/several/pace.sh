#!/usr/bin/env bash
# A trial to go on from the PONDER of count.sh, on two CPU cores: see docs/training.md, "Counts".
#
#     checkpoints/several/pace.sh [OUT]    (the OUT of the other scripts)
#
# Twice as many scenes of what is to be stopped in time, a third of the rows; all else as note.sh has collected it. The same
# command goes on after a kill.
set -euo pipefail

out=${1:-out/several}
noted=$out/note
before=$out/count
next=$out/pace
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

collect "$next/timed" --tasks StopCube --episodes 300 --invocation-hz 20
data=("$next/timed" "$next/timed" "$noted/swaps" "$noted/repick" "$noted/shown" "$noted/old" "$noted/filled" "$noted/imitated"
    "$noted/highlight")

settle small_pacing "$before/pair/ponder" "$before/pair/pounce" "$next" --data "${data[@]}" --sights "$noted/sights"
evaluate "$next/pair" "$next"
