#!/usr/bin/env bash
# Goes on from the pair that insert.sh has left: see docs/training.md, "To the end".
#
#     checkpoints/several/to_the_end.sh [OUT]    (the OUT of the other scripts)
#
# Videos are shown to their end, in rows and in play. It was run by its parts and not as it stands here. The recipe's further
# stages, none of which was shipped, are not in it.
set -euo pipefail

out=${1:-out/several}
grown=$out/grow
long=$out/long
side=$out/side
pegs=$out/insert
next=$out/end
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

collect "$next/pegs" --tasks InsertPeg --episodes 400 --first-episode 3000 --recovery-share 0.5 --invocation-hz 2
show() { collect "$next/$1" --tasks "$2" --episodes "$3" --first-episode "$4" --invocation-hz 2; }
show pattern PatternLock 100 4000
show pattern-more PatternLock 80 5000
show route RouteStick 80 4000
show route-more RouteStick 60 5000
show move MoveCube 30 4000
show move-more MoveCube 40 5000
show order VideoPlaceOrder 40 4000
show button VideoPlaceButton 30 4000
show repick VideoRepick 30 4000
show swap VideoUnmaskSwap 30 4000
show unmask VideoUnmask 40 5000
collect "$next/swing" --tasks SwingXtimes --episodes 60 --first-episode 6000
collect "$next/pick" --tasks PickXtimes --episodes 60 --first-episode 6000
collect "$next/button-swap" --tasks ButtonUnmaskSwap --episodes 50 --first-episode 6000
collect "$next/fill" --tasks BinFill --episodes 30 --first-episode 6000

data=("$next/pegs" "$pegs/pegs" "$pegs/more" "$pegs/missed")
hand=("${data[@]}" "${data[@]}" "$side/route" "$side/filled" "$side/filled")
for kind in imitated shown old swaps repick timed filled filled highlight; do hand+=("$long/$kind" "$grown/$kind"); done
[ -d "$next/hand/run/righting/pounce" ] || "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole \
    --recipe small_inserting --stage righting --ponder "$side/open/ponder" --pounce "$pegs/run/righting/pounce" \
    --out "$next/hand/run" --data "${hand[@]}"

[ -d "$next/begun" ] || blend "$side/open/ponder" "$pegs/run/settling/ponder" 0.75 "$next/begun"
for kind in route route-more order button repick swap; do data+=("$next/$kind" "$next/$kind"); done
for kind in pattern pattern-more move move-more unmask swing pick button-swap fill; do data+=("$next/$kind"); done
data+=("$side/route" "$side/filled")
for kind in imitated filled shown old swaps swaps repick timed timed highlight highlight; do data+=("$long/$kind" "$grown/$kind"); done
settle small_to_the_end "$next/begun" "$next/hand/run/righting/pounce" "$next" --data "${data[@]}" --sights "$side/sights" \
    --watch "$side/ways" "$side/rest" "$grown/a" "$grown/b" --watch-share 0.15 --products bfloat16
look_again "$next/pair/ponder" 6 8 'highlight|hides|correct|grasping'
take_none "$next/pair/ponder"
evaluate "$next/pair" "$next" InsertPeg --video-end
