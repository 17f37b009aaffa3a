#!/usr/bin/env bash
# Goes on from the pair that lengthen.sh has left, on two CPU cores: see docs/training.md, "Twice a second".
#
#     checkpoints/several/twice.sh [OUT]    (the OUT of the other scripts)
#
# PONDER looks at demonstrations twice a second instead of once, and at their last frame. It was run by its parts.
set -euo pipefail

out=${1:-out/several}
long=$out/long
next=$out/two
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

fresh=(--first-episode 8000 --invocation-hz 2)  # other scenes than all before
noisy=(--recovery-share 0.2 --shove-share 0.3)
shown=("${fresh[@]}" --demonstration-hz 2)
collect "$next/button-swap" --tasks ButtonUnmaskSwap --episodes 60 "${fresh[@]}" "${noisy[@]}"
collect "$next/timed" --tasks StopCube --episodes 80 --first-episode 8000 --invocation-hz 20
collect "$next/highlight" --tasks PickHighlight --episodes 60 "${fresh[@]}" --recovery-share 0.4 --shove-share 0.5
collect "$next/old" --tasks ButtonUnmask PickXtimes SwingXtimes --episodes 42 "${fresh[@]}" "${noisy[@]}"
collect "$next/fill" --tasks BinFill --episodes 70 "${fresh[@]}" "${noisy[@]}"
collect "$next/repick" --tasks VideoRepick --episodes 125 "${shown[@]}" "${noisy[@]}"
collect "$next/swap" --tasks VideoUnmaskSwap --episodes 140 "${shown[@]}" "${noisy[@]}"
collect "$next/pattern" --tasks PatternLock --episodes 90 "${shown[@]}"
collect "$next/place" --tasks VideoPlaceButton VideoPlaceOrder --episodes 45 "${shown[@]}" "${noisy[@]}"
collect "$next/unmask" --tasks VideoUnmask --episodes 36 "${shown[@]}" "${noisy[@]}"
collect "$next/move" --tasks MoveCube --episodes 36 "${shown[@]}"
collect "$next/route" --tasks RouteStick --episodes 50 "${shown[@]}"

mkdir -p "$next/first"
cp -r "$long/pair/ponder" "$long/pair/pounce" "$next/first"
take_none "$next/first/ponder"
play "$next/first" 8 1996000 "$next/played" PickHighlight BinFill PickXtimes SwingXtimes ButtonUnmaskSwap ButtonUnmask
retell "$next/played" "$next/watched"

data=("$next/route")
for kind in swap repick pattern timed fill highlight button-swap old place unmask move; do data+=("$next/$kind" "$next/$kind"); done
data+=("$next/timed" "$next/highlight")
settle small_twice_a_second "$long/pair/ponder" "$long/pair/pounce" "$next" --data "${data[@]}" --sights "$next/sights" \
    --watch "$next/watched" --watch-share 0.17 --products bfloat16
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct'
take_none "$next/pair/ponder"
evaluate "$next/pair" "$next"
