#!/usr/bin/env bash
# Goes on from the pair that lengthen.sh has left, on two CPU cores: see docs/training.md, "A reader of demonstrations".
#
#     checkpoints/several/read.sh [OUT]    (the OUT of the other scripts, twice.sh among them)
#
# What twice.sh has left becomes a reader beside the PONDER that it began as, and learns alone. It was run by its parts.
set -euo pipefail

out=${1:-out/several}
long=$out/long
two=$out/two
next=$out/three
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

shown=(--first-episode 9000 --invocation-hz 2 --demonstration-hz 2)  # other scenes than all before
noisy=("${shown[@]}" --recovery-share 0.2 --shove-share 0.3)
collect "$next/move" --tasks MoveCube --episodes 80 "${shown[@]}"
collect "$next/route" --tasks RouteStick --episodes 100 "${shown[@]}"
collect "$next/unmask" --tasks VideoUnmask --episodes 50 "${noisy[@]}"
collect "$next/pattern" --tasks PatternLock --episodes 100 "${shown[@]}"
collect "$next/place" --tasks VideoPlaceButton VideoPlaceOrder --episodes 35 "${noisy[@]}"
collect "$next/repick" --tasks VideoRepick --episodes 80 "${noisy[@]}"
collect "$next/swap" --tasks VideoUnmaskSwap --episodes 90 "${noisy[@]}"

give_reader "$long/pair/ponder" "$two/run/settling/ponder" "$next/begin"
data=()
for kind in swap repick pattern place unmask unmask move route; do data+=("$two/$kind" "$next/$kind"); done
settle small_reading "$next/begin" "$long/pair/pounce" "$next" --data "${data[@]}" --sights "$two/sights" --products bfloat16
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct'
take_counsel "$next/pair/ponder" others 2,-3 -2,2,mirrored
evaluate "$next/pair" "$next"
