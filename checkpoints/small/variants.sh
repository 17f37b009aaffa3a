#!/usr/bin/env bash
# Table 3 and Figure 4 of the paper at small scale, from the shipped pair: see docs/training.md, "Table 3, Table 4 and Figure 4
# at small scale". Some two hours on two CPU cores, by its parts; it was not run in one go.
#
#     checkpoints/small/variants.sh [OUT]     (`make setup` sets everything up first)
#
# The shipped pair goes on in four ways, with the same data and as many steps: PONDER looking every 1, 2 or 4 s, and every
# second without a word. A POUNCE learns to read the words. All are played in the first 60 test scenes, and the shipped PONDER
# as well, asked for no words; pairs that look now and then are asked offline what older cognition costs. The same command goes
# on after a kill.
set -euo pipefail

out=${1:-out/small/variants}
bin=${BIN:-.venv/bin}
here=$(dirname "$0")
source "$here/common.sh"
export OMP_NUM_THREADS=1 MUJOCO_GL=${MUJOCO_GL:-egl}

[ -d "$out/data/meta" ] || "$bin/pp-collect" --tasks PickHighlight --episodes 330 --noise dart --recovery-share 0.4 \
    --frames training --invocation-hz 5 --difficulties easy medium hard --order near-first --texts follow \
    --shove-share 0.35 --out "$out/data"

train() {  # RECIPE, into the folder of its name
    [ -d "$out/$1/pounce" ] || "$bin/pp-train" --recipe "$1" --data "$out/data" --ponder "$here/ponder" \
        --pounce "$here/pounce" --sights "$out/sights" --out "$out/$1" --no-progress
}

{ train small_refresh_1s; train small_refresh_2s; train small_refresh_4s; } & looking=$!
train small_subgoal_text
train small_wordless
wait $looking

play() {  # NAME of the condition, PONDER, POUNCE, options
    local name=$1 ponder=$2 pounce=$3; shift 3
    "$bin/pp-eval" --tasks PickHighlight --episodes 60 --runs 1 --seed 1000 --workers 2 --ponder-checkpoint "$ponder" \
        --pounce-checkpoint "$pounce" --out "$out/results/$name" "$@"
}

for period in 1 2 4; do
    pair=$out/small_refresh_${period}s
    play "refresh${period}s" "$pair/ponder" "$pair/pounce" --query-period-ms "${period}000"
done
play wordless "$out/small_wordless/ponder" "$out/small_wordless/pounce"

silent=$out/silent/ponder  # the shipped PONDER, asked for no words
mkdir -p "$silent"
cp "$here"/ponder/* "$silent"
sed -i.before 's/"speaks": true/"speaks": false/' "$silent/ponder.json"
play silent "$silent" "$here/pounce"
play text "$here/ponder" "$out/small_subgoal_text/pounce" --subgoal-text ponder
play text-oracle "$here/ponder" "$out/small_subgoal_text/pounce" --subgoal-text oracle --order near-first

# What the pairs make of older cognition, on episodes of the oracle's that none of them has seen.
"$bin/pp-eval" --tasks PickHighlight --policy oracle --order near-first --episodes 48 --runs 1 --seed 600000 --record \
    --record-hz 5 --workers 2 --out "$out/held"
mapfile -t found < <(logs "$out/held")
[ -d "$out/held-out/meta" ] || "$bin/pp-export" "${found[@]}" --out "$out/held-out"
for period in 1 2 4; do
    pair=$out/small_refresh_${period}s
    "$bin/pp-diagnose" --ponder "$pair/ponder" --pounce "$pair/pounce" --data "$out/held-out" --out "$out/results/offline${period}s"
done
"$bin/pp-diagnose" --ponder "$here/ponder" --pounce "$here/pounce" --data "$out/held-out" --out "$out/results/offline"
if [ ! -e "$out/results/offline/counterfactual.json" ]; then
    rm -rf "$out/pairs"  # a kill left the beginning
    "$bin/pp-pairs" --family reference --task PickHighlight --pairs 100 --out "$out/pairs"
    "$bin/pp-counterfactual" --ponder "$here/ponder" --pounce "$here/pounce" --pairs "$out/pairs" --out "$out/results/offline"
fi

tables() {  # NAME of a table, folders of results
    local name=$1; shift
    "$bin/pp-tables" "${@/#/$out/results/}" --out "$out/results/tables/$name"
}

tables variants refresh1s wordless text text-oracle
tables slow refresh1s refresh2s refresh4s
tables offline offline1s offline2s offline4s offline
