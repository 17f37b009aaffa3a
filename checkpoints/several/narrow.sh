#!/usr/bin/env bash
# Goes on from the reader that read.sh has left, on two CPU cores: see docs/training.md, "In three bits".
#
#     checkpoints/several/narrow.sh [OUT]    (the OUT of the other scripts, read.sh among them)
#
# Its first six layers learn on, as they are stored: a pair fits into 20 MB. It was run by its parts.
set -euo pipefail

out=${1:-out/several}
two=$out/two
three=$out/three
next=$out/four
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

shown=(--first-episode 9200 --invocation-hz 2 --demonstration-hz 2)  # other scenes than all before
noisy=("${shown[@]}" --recovery-share 0.2 --shove-share 0.3)
collect "$next/unmask" --tasks VideoUnmask --episodes 90 "${noisy[@]}"
collect "$next/route" --tasks RouteStick --episodes 90 "${shown[@]}"
collect "$next/swap" --tasks VideoUnmaskSwap --episodes 90 "${noisy[@]}"
collect "$next/repick" --tasks VideoRepick --episodes 60 "${noisy[@]}"
collect "$next/place" --tasks VideoPlaceOrder --episodes 60 "${noisy[@]}"
collect "$next/pattern" --tasks PatternLock --episodes 60 "${shown[@]}"

data=("$two/move" "$three/move")
for kind in swap repick pattern place unmask unmask route; do data+=("$two/$kind" "$three/$kind" "$next/$kind"); done
settle small_in_three_bits "$three/run/settling/ponder" "$three/pair/pounce" "$next" --data "${data[@]}" --sights "$two/sights" --products bfloat16
narrow_reader "$next/run/settling/ponder" "$next/pair/ponder" 6 3
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct'
take_counsel "$next/pair/ponder" others 2,-3 -2,2,mirrored
evaluate "$next/pair" "$next"
