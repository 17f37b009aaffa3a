#!/usr/bin/env bash
# The pair for several tasks from the one that is shipped, on two CPU cores: see docs/training.md, "Four tasks more".
#
#     checkpoints/several/imitate.sh [OUT]
#
# Two tasks with a stick, one with three manners and one to be done on the second are added. PONDER's eyes are shown what there is
# in them, both get words for them, POUNCE learns to go along ways, to push and to wait, and PONDER to note what demonstrations do.
# The same command goes on after a kill. It was run by its parts and by hand, never as one.
set -euo pipefail

out=${1:-out/imitate}
bin=${BIN:-.venv/bin}
here=$(dirname "$0")
source "$here/../small/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}
imitated=(MoveCube PatternLock RouteStick)
shown=(VideoPlaceButton VideoPlaceOrder VideoRepick)
old=(ButtonUnmask VideoUnmask PickXtimes SwingXtimes BinFill)
swapped=(ButtonUnmaskSwap VideoUnmaskSwap)

noisy=(--recovery-share 0.2 --shove-share 0.3)
collect "$out/imitated" --tasks "${imitated[@]}" --episodes 150 "${noisy[@]}"
collect "$out/shown" --tasks "${shown[@]}" --episodes 130 "${noisy[@]}"
collect "$out/old" --tasks "${old[@]}" --episodes 100 "${noisy[@]}"
collect "$out/swaps" --tasks "${swapped[@]}" --episodes 40 "${noisy[@]}"
collect "$out/highlight" --tasks PickHighlight --episodes 150 --recovery-share 0.4 --shove-share 0.7
collect "$out/timed" --tasks StopCube --episodes 150 --invocation-hz 20  # waits are counted in single steps
data=("$out/imitated" "$out/timed" "$out/shown" "$out/old" "$out/swaps" "$out/highlight")

look() {  # at so many PICTURES of a TASK
    [ -d "$out/album/$2/meta" ] || "$bin/pp-album" --task "$2" --pictures "$1" --out "$out/album/$2"
}

for task in PickHighlight ButtonUnmask PickXtimes BinFill SwingXtimes; do look 600 $task; done
for task in StopCube MoveCube; do look 1200 $task; done
for task in PatternLock RouteStick; do look 1500 $task; done
[ -d "$out/eyes/ponder" ] || OMP_NUM_THREADS=2 "$bin/pp-see" --recipe small_imitating --data "$out/imitated" --album "$out"/album/* \
    --ponder "$here/ponder" --steps 800 --learning-rate 5e-4 --out "$out/eyes"
[ -d "$out/wide/ponder" ] || "$bin/pp-widen" --ponder "$out/eyes/ponder" --pounce "$here/pounce" --data "${data[@]}" \
    --pieces 128 --out "$out/wide"

how=(--recipe small_imitating --data "${data[@]}" --ponder "$out/wide/ponder" --pounce "$out/wide/pounce" --sights "$out/sights"
    --out "$out/run")
train_on_both_cores() { "$bin/torchrun" --nproc-per-node=2 -m ponderpounce.training.train --weights whole "${how[@]}" "$@"; }

[ -d "$out/run/hand/pounce" ] || "$bin/pp-train" "${how[@]}" --stage hand & acting=$!
[ -d "$out/run/binding/ponder" ] || "$bin/pp-train" "${how[@]}" --stage binding --no-progress
wait $acting
[ -d "$out/run/carrying/pounce" ] || train_on_both_cores --stage carrying
"$bin/pp-eval" --tasks PickXtimes SwingXtimes BinFill VideoPlaceButton VideoPlaceOrder ButtonUnmask VideoUnmask --episodes 24 --runs 1 \
    --seed 1900000 --max-steps 1000 --order near-first --record --record-hz 5 --cognition stand-in --stand-in-noise-px 2 \
    --stand-in-onward --workers 2 --pounce-checkpoint "$out/run/carrying/pounce" --out "$out/played"
mapfile -t found < <(logs "$out/played")
[ -d "$out/watched/meta" ] || "$bin/pp-export" "${found[@]}" --out "$out/watched"
[ -d "$out/run/ponder" ] || train_on_both_cores --stage finishing --watch "$out/watched" --watch-share 0.17

pair="$out/pair"
[ -d "$pair/ponder" ] || halve "$out/run/ponder" "$pair/ponder"
[ -d "$pair/pounce" ] || halve "$out/run/carrying/pounce" "$pair/pounce"
for cognition in real null; do
    "$bin/pp-eval" --tasks PickHighlight StopCube "${imitated[@]}" "${shown[@]}" "${old[@]}" "${swapped[@]}" --episodes 50 --runs 1 \
        --seed 1000 --workers 2 --cognition $cognition --ponder-checkpoint "$pair/ponder" --pounce-checkpoint "$pair/pounce" \
        --out "$out/$cognition"
done
"$bin/pp-tables" "$out/real" "$out/null" --out "$out/tables"
