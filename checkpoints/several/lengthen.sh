#!/usr/bin/env bash
# Goes on from the pair that grow.sh has left, on one GPU with 16 cores beside it: see docs/training.md, "At length".
#
#     checkpoints/several/lengthen.sh [OUT]    (the OUT of the other scripts)
#
# PONDER's stream becomes a third broader, its tower and its eye two layers deeper, and it reads nine times as many rows
# as in grow.sh. It was not run like this, but by its parts, with the rate falling by the clock.
set -euo pipefail

out=${1:-out/several}
grown=$out/grow
next=$out/long
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

further=(--first-episode 1000 --recovery-share 0.2 --shove-share 0.3 --invocation-hz 2)  # other scenes than grow.sh's
collect "$next/repick" --tasks VideoRepick --episodes 90 "${further[@]}"
collect "$next/imitated" --tasks PatternLock RouteStick --episodes 80 "${further[@]}"
collect "$next/swaps" --tasks ButtonUnmaskSwap VideoUnmaskSwap --episodes 80 "${further[@]}"
collect "$next/filled" --tasks BinFill --episodes 80 "${further[@]}"
collect "$next/shown" --tasks VideoPlaceButton VideoPlaceOrder --episodes 60 "${further[@]}"
collect "$next/old" --tasks ButtonUnmask VideoUnmask PickXtimes SwingXtimes --episodes 60 "${further[@]}"
collect "$next/timed" --tasks StopCube --episodes 80 --first-episode 1000 --invocation-hz 20
collect "$next/highlight" --tasks PickHighlight MoveCube --episodes 40 "${further[@]}"

[ -d "$next/larger/ponder" ] || "$bin/pp-enlarge" --ponder "$grown/pair/ponder" --pounce "$grown/pair/pounce" \
    --out "$next/larger" --hidden-size 256 --layers 2 --eye-layers 2
data=()
for kind in timed swaps repick shown old filled imitated highlight; do
    times=2
    case $kind in repick | filled | imitated) times=3 ;; esac
    for ((time = 0; time < times; time++)); do data+=("$grown/$kind" "$next/$kind"); done
done
[ -d "$next/run/settling/ponder" ] || "$bin/pp-train" --recipe small_at_length --stage settling --device cuda \
    --products tfloat32 --loaders 14 --length-groups 3 --ponder "$next/larger/ponder" --pounce "$next/larger/pounce" \
    --data "${data[@]}" --watch "$grown/a" "$grown/b" --watch-share 0.15 --sights "$next/sights" --out "$next/run"
[ -d "$next/pair/ponder" ] || halve "$next/run/settling/ponder" "$next/pair/ponder"
[ -d "$next/pair/pounce" ] || halve "$next/larger/pounce" "$next/pair/pounce"
evaluate "$next/pair" "$next"
