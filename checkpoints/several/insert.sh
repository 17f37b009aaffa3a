#!/usr/bin/env bash
# Goes on from the pair that see_wider.sh has left: see docs/training.md, "Pegs".
#
#     checkpoints/several/insert.sh [OUT]    (the OUT of the other scripts)
#
# The last of sixteen tasks is added: POUNCE learns to put a peg into a box, PONDER to tell which end of which peg, and from which
# side. It was run by its parts and not as it stands here.
set -euo pipefail

out=${1:-out/several}
grown=$out/grow
long=$out/long
side=$out/side
next=$out/insert
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

collect "$next/pegs" --tasks InsertPeg --episodes 240 --invocation-hz 2
collect "$next/more" --tasks InsertPeg --episodes 120 --first-episode 1000 --invocation-hz 2
collect "$next/missed" --tasks InsertPeg --episodes 100 --first-episode 2000 --invocation-hz 2 --recovery-share 1.0

data=("$next/pegs" "$next/more")
act() {  # POUNCE goes on by a STAGE, from POUNCE; what else is to be learned from is the rest
    [ -d "$next/run/$1/pounce" ] || "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole \
        --recipe small_inserting --stage "$1" --ponder "$side/open/ponder" --pounce "$2" --out "$next/run" --data "${@:3}"
}
all=("${data[@]}" "${data[@]}" "${data[@]}" "$side/route" "$side/filled" "$side/filled")
for kind in imitated filled shown old swaps repick timed highlight; do all+=("$long/$kind" "$grown/$kind"); done
act hand "$side/wide/pounce" "${all[@]}"
act righting "$next/run/hand/pounce" "$next/missed" "$next/missed" "$next/missed" "${all[@]}"

all=("${data[@]}" "${data[@]}" "$side/route" "$side/route" "$side/filled")
for kind in imitated imitated filled shown old swaps repick timed timed highlight; do all+=("$long/$kind" "$grown/$kind"); done
settle small_inserting "$side/run/settling/ponder" "$next/run/righting/pounce" "$next" --data "${all[@]}" --sights "$side/sights" \
    --watch "$side/ways" "$side/rest" "$grown/a" "$grown/b" --watch-share 0.15 --products bfloat16
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct|grasping'
take_counsel "$next/pair/ponder" all 2,-3 -2,2,mirrored
evaluate "$next/pair" "$next" InsertPeg
