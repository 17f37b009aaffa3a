#!/usr/bin/env bash
# Goes on from the pair that lengthen.sh has left: see docs/training.md, "By sight".
#
#     checkpoints/several/see_wider.sh [OUT]    (the OUT of the other scripts)
#
# PONDER's eye takes in all that is played with, and plans are told in words that it has seen or counted before. A trial,
# run by its parts before stretches of ways had numbers; what it left is not shipped.
set -euo pipefail

out=${1:-out/several}
grown=$out/grow
long=$out/long
next=$out/side
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

further=(--first-episode 2000 --recovery-share 0.2 --shove-share 0.3 --invocation-hz 2)
collect "$next/route" --tasks RouteStick --episodes 140 "${further[@]}"
collect "$next/filled" --tasks BinFill --episodes 40 "${further[@]}"

play "$long/pair" 14 794000 "$next/ways-played" RouteStick PatternLock
play "$long/pair" 12 794100 "$next/rest-played" VideoRepick SwingXtimes MoveCube VideoPlaceOrder BinFill PickXtimes \
    VideoUnmaskSwap ButtonUnmaskSwap
for played in ways rest; do retell "$next/$played-played" "$next/$played"; done

[ -d "$next/wide/ponder" ] || "$bin/pp-enlarge" --ponder "$long/run/settling/ponder" --pounce "$long/larger/pounce" \
    --out "$next/wide" --box 8 32 168 224
data=("$next/route" "$next/filled" "$long/filled" "$grown/filled" "$long/shown" "$grown/shown")
data+=("${data[@]}" "$next/route")
for kind in imitated old swaps repick timed highlight; do data+=("$long/$kind" "$grown/$kind"); done
settle small_by_sight "$next/wide/ponder" "$next/wide/pounce" "$next" --data "${data[@]}" --sights "$next/sights" \
    --watch "$next/ways" "$next/rest" "$grown/a" "$grown/b" --watch-share 0.2 --products bfloat16
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct'
take_counsel "$next/pair/ponder" 2,-3 -2,2,mirrored
evaluate "$next/pair" "$next"
