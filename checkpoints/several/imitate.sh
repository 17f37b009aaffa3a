#!/usr/bin/env bash
# The pair for several tasks from the one that further.sh has left, on two CPU cores: see docs/training.md, "Four tasks more".
#
#     checkpoints/several/imitate.sh [OUT]    (the OUT of train.sh and further.sh)
#
# Two tasks with a stick, one with three manners and one to be done on the second are added. PONDER's eyes are shown what there is
# in them, both get words for them, POUNCE learns to go along ways, to push and to wait, and PONDER to note what demonstrations do.
# The same command goes on after a kill. It was run by its parts and by hand, never as one.
set -euo pipefail

out=${1:-out/several}
more=$out/imitate
bin=${BIN:-.venv/bin}
source "$(dirname "$0")/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}
imitated=(MoveCube PatternLock RouteStick)
shown=(VideoPlaceButton VideoPlaceOrder VideoRepick)
old=(ButtonUnmask VideoUnmask PickXtimes SwingXtimes BinFill)
swapped=(ButtonUnmaskSwap VideoUnmaskSwap)

noisy=(--recovery-share 0.2 --shove-share 0.3)
collect "$more/imitated" --tasks "${imitated[@]}" --episodes 150 "${noisy[@]}"
collect "$more/shown" --tasks "${shown[@]}" --episodes 130 "${noisy[@]}"
collect "$more/old" --tasks "${old[@]}" --episodes 100 "${noisy[@]}"
collect "$more/swaps" --tasks "${swapped[@]}" --episodes 40 "${noisy[@]}"
collect "$more/highlight" --tasks PickHighlight --episodes 150 --recovery-share 0.4 --shove-share 0.7
collect "$more/timed" --tasks StopCube --episodes 150 --invocation-hz 20  # waits are counted in single steps
data=("$more/imitated" "$more/timed" "$more/shown" "$more/old" "$more/swaps" "$more/highlight")

look() {  # at so many PICTURES of a TASK
    [ -d "$more/album/$2/meta" ] || "$bin/pp-album" --task "$2" --pictures "$1" --out "$more/album/$2"
}

for task in PickHighlight ButtonUnmask PickXtimes BinFill SwingXtimes; do look 600 $task; done
for task in StopCube MoveCube; do look 1200 $task; done
for task in PatternLock RouteStick; do look 1500 $task; done
[ -d "$more/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small_imitating --data "$more/imitated" --album "$more"/album/* \
    --ponder "$out/further/pair/ponder" --steps 800 --learning-rate 5e-4 --out "$more/eyes"
[ -d "$more/wide/ponder" ] || "$bin/pp-widen" --ponder "$more/eyes/ponder" --pounce "$out/further/pair/pounce" --data "${data[@]}" \
    --pieces 128 --out "$more/wide"

how=(--recipe small_imitating --data "${data[@]}" --ponder "$more/wide/ponder" --pounce "$more/wide/pounce" --sights "$more/sights"
    --out "$more/run")
train_on_both_cores() { "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole "${how[@]}" "$@"; }

[ -d "$more/run/hand/pounce" ] || "$bin/pp-train" "${how[@]}" --stage hand & acting=$!
[ -d "$more/run/binding/ponder" ] || "$bin/pp-train" "${how[@]}" --stage binding --no-progress
wait $acting
[ -d "$more/run/carrying/pounce" ] || train_on_both_cores --stage carrying
"$bin/pp-eval" --tasks PickXtimes SwingXtimes BinFill VideoPlaceButton VideoPlaceOrder ButtonUnmask VideoUnmask --episodes 24 --runs 1 \
    --seed 1900000 --max-steps 1000 --order near-first --record --record-hz 5 --cognition stand-in --stand-in-noise-px 2 \
    --stand-in-onward --workers 2 --pounce-checkpoint "$more/run/carrying/pounce" --out "$more/played"
mapfile -t found < <(logs "$more/played")
[ -d "$more/watched/meta" ] || "$bin/pp-export" "${found[@]}" --out "$more/watched"
[ -d "$more/run/finishing/ponder" ] || train_on_both_cores --stage finishing --watch "$more/watched" --watch-share 0.17
[ -d "$more/run/recalling/ponder" ] || train_on_both_cores --stage recalling --tasks "${imitated[@]}" "${shown[@]}" VideoUnmask VideoUnmaskSwap
[ -d "$more/run/waiting/pounce" ] || train_on_both_cores --stage waiting
[ -d "$more/run/settling/ponder" ] || train_on_both_cores --stage settling --watch "$more/watched" --watch-share 0.17

pair="$more/pair"
[ -d "$pair/ponder" ] || halve "$more/run/settling/ponder" "$pair/ponder"
[ -d "$pair/pounce" ] || halve "$more/run/waiting/pounce" "$pair/pounce"
evaluate "$pair" "$more"
