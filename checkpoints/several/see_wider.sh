#!/usr/bin/env bash
# Goes on from the pair that lengthen.sh has left: see docs/training.md, "Looked up".
#
#     checkpoints/several/see_wider.sh [OUT]    (the OUT of the other scripts)
#
# PONDER's eye takes in all that is played with, around what it saw before; ways are told as they were seen, and looked up
# in notes. A trial, run by its parts and not as it stands here; what it left is not shipped.
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

look() {  # at so many PICTURES of a TASK, or of its demonstrations
    [ -d "$next/album/$3/meta" ] || "$bin/pp-album" --task "$2" --pictures "$1" "${@:4}" --out "$next/album/$3"
}

for task in RouteStick VideoPlaceOrder BinFill StopCube PickHighlight ButtonUnmaskSwap PatternLock MoveCube VideoRepick \
    VideoUnmaskSwap SwingXtimes; do look 800 $task $task --seed 3500000; done
look 600 RouteStick RouteStick-shown --demonstrated --seed 3600000
for task in MoveCube PatternLock; do look 500 $task $task-shown --demonstrated --seed 3600000; done

[ -d "$next/wide/ponder" ] || "$bin/pp-enlarge" --ponder "$long/run/settling/ponder" --pounce "$long/larger/pounce" \
    --out "$next/wide" --box 8 32 168 224
[ -d "$next/open/ponder" ] || "$bin/pp-see" --recipe small --ponder "$next/wide/ponder" --like "$long/run/settling/ponder" \
    --album "$next"/album/* --data "$grown"/{imitated,shown,swaps,filled,repick} "$next/route" --settling 300 --steps 500 \
    --learning-rate 5e-4 --pictures 96 --out "$next/open"
learn small_by_sight reciting "$next/open/ponder" "$next/wide/pounce" "$next" --tasks PatternLock RouteStick \
    --data "$next/route" "$long/imitated" "$grown/imitated" --sights "$next/sights" --products bfloat16
data=("$next/route" "$next/route" "$next/route" "$next/filled")
for kind in imitated imitated imitated imitated filled filled shown shown old swaps swaps repick timed timed timed highlight; do
    data+=("$long/$kind" "$grown/$kind")
done
data+=("$grown/old" "$grown/repick")
settle small_by_sight "$next/run/reciting/ponder" "$next/wide/pounce" "$next" --data "${data[@]}" --sights "$next/sights" \
    --watch "$next/ways" "$next/rest" "$grown/a" "$grown/b" --watch-share 0.15 --products bfloat16
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct'
take_counsel "$next/pair/ponder" all 2,-3 -2,2,mirrored
evaluate "$next/pair" "$next"
