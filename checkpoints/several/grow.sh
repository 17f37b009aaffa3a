#!/usr/bin/env bash
# Goes on from the pair that begin.sh has left, on two CPU cores: see docs/training.md, "Half as broad again".
#
#     checkpoints/several/grow.sh [OUT]    (the OUT of the other scripts)
#
# PONDER's stream becomes half as broad again and two layers deeper, and learns from episodes that are collected anew. The same
# command goes on after a kill. It was run by its parts.
set -euo pipefail

out=${1:-out/several}
begun=$out/begin
next=$out/grow
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

noisy=(--recovery-share 0.2 --shove-share 0.3)
sparse=("${noisy[@]}" --invocation-hz 2)  # POUNCE does not learn here
collect "$next/shown" --tasks VideoPlaceButton VideoPlaceOrder --episodes 100 "${noisy[@]}"
collect "$next/swaps" --tasks ButtonUnmaskSwap VideoUnmaskSwap --episodes 70 "${sparse[@]}"
collect "$next/old" --tasks ButtonUnmask VideoUnmask PickXtimes SwingXtimes --episodes 80 "${sparse[@]}"
collect "$next/timed" --tasks StopCube --episodes 150 --invocation-hz 20
collect "$next/repick" --tasks VideoRepick --episodes 90 "${sparse[@]}"
collect "$next/imitated" --tasks MoveCube PatternLock RouteStick --episodes 80 "${sparse[@]}"
collect "$next/filled" --tasks BinFill --episodes 110 "${sparse[@]}"
collect "$next/highlight" --tasks PickHighlight --episodes 80 --recovery-share 0.4 --shove-share 0.7 --invocation-hz 2

pair=$begun/pair
play "$pair" 5 1999200 "$next/a-played" PickXtimes SwingXtimes BinFill ButtonUnmask VideoPlaceButton VideoUnmask PickHighlight MoveCube
play "$pair" 4 1999300 "$next/b-played" VideoPlaceOrder VideoRepick ButtonUnmaskSwap StopCube RouteStick
for played in a b; do retell "$next/$played-played" "$next/$played"; done

[ -d "$next/larger/ponder" ] || "$bin/pp-enlarge" --ponder "$pair/ponder" --pounce "$pair/pounce" --out "$next/larger" \
    --hidden-size 192 --layers 2
[ -d "$next/pair/pounce" ] || halve "$next/larger/pounce" "$next/pair/pounce"
data=()
for kind in timed timed timed swaps swaps repick repick shown shown old old filled filled imitated imitated highlight highlight; do
    data+=("$next/$kind")
done
settle small_growing "$next/larger/ponder" "$next/larger/pounce" "$next" --data "${data[@]}" --sights "$next/sights" \
    --watch "$next/a" "$next/b" --watch-share 0.15 --products bfloat16
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct'
take_counsel "$next/pair/ponder" all 2,-3 -2,2,mirrored
evaluate "$next/pair" "$next"
