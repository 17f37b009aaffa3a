#!/usr/bin/env bash
# Goes on from the PONDER of pace.sh, on two CPU cores, and leaves the shipped pair: see docs/training.md, "Places put right".
#
#     checkpoints/several/watch.sh [OUT]    (the OUT of the other scripts)
#
# Waits are told as they are, places told where another thing is are to be put right, sides noted when they are seen, and some
# rows are of what the pair before has played. All else as note.sh and pace.sh have collected it. The same command goes on after
# a kill. It was run by its parts.
set -euo pipefail

out=${1:-out/several}
noted=$out/note
paced=$out/pace
next=$out/watch
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

play "$paced/pair" 12 1996000 "$next/counted-played" PickXtimes SwingXtimes BinFill
retell "$next/counted-played" "$next/counted"
data=("$paced/timed" "$noted/swaps" "$noted/swaps" "$noted/repick" "$noted/shown" "$noted/shown" "$noted/old" "$noted/filled"
    "$noted/imitated" "$noted/highlight")

settle small_watching "$paced/pair/ponder" "$paced/pair/pounce" "$next" --data "${data[@]}" --sights "$noted/sights" \
    --watch "$next/counted" --watch-share 0.15
evaluate "$next/pair" "$next"
