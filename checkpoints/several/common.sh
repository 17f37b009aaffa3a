# What the scripts beside it have in common; each sets $bin.

source "$(dirname "${BASH_SOURCE[0]}")/../small/common.sh"

play() {  # a PAIR plays EPISODES each from SEED on, recorded INTO a folder, of TASKS
    local pair=$1 into=$4
    "$bin/pp-eval" --tasks "${@:5}" --episodes "$2" --runs 1 --seed "$3" --max-steps 900 \
        --order near-first --record --record-hz 5 --workers 2 --out "$into" \
        --ponder-checkpoint "$pair/ponder" --pounce-checkpoint "$pair/pounce"
}

retell() {  # what was played in the folder FROM, told as things then stood, becomes the dataset INTO
    local from=$1 into=$2 found
    mapfile -t found < <(logs "$from")
    [ -d "$into/meta" ] || "$bin/pp-export" "${found[@]}" --texts follow --order near-first --demonstration-hz 1 --out "$into"
}

learn() {  # a PONDER goes on by a STAGE of RECIPE INTO a folder, beside POUNCE; the rest is pp-train's
    local recipe=$1 stage=$2 ponder=$3 pounce=$4 into=$5; shift 5
    [ -d "$into/run/$stage/ponder" ] || "$bin/torchrun" --nproc-per-node=2 -m dual_system.training.train --weights whole \
        --recipe "$recipe" --stage "$stage" --ponder "$ponder" --pounce "$pounce" --out "$into/run" "$@"
}

settle() {  # a PONDER goes on by RECIPE's `settling` INTO a folder, and makes a pair there with POUNCE; the rest is pp-train's
    local recipe=$1 ponder=$2 pounce=$3 into=$4; shift 4
    learn "$recipe" settling "$ponder" "$pounce" "$into" "$@"
    [ -d "$into/pair/ponder" ] || halve "$into/run/settling/ponder" "$into/pair/ponder"
    [ -d "$into/pair/pounce" ] || cp -r "$pounce" "$into/pair/pounce"
}

look_again() {  # a PONDER's folder is served with a second look AFTER so many queries, of places LEAST apart, UNLESS words say so
    "$bin/python" -c 'import json, pathlib, sys
path, after, least, unless = pathlib.Path(sys.argv[1], "ponder.json"), *map(int, sys.argv[2:4]), sys.argv[4]
stored = json.loads(path.read_text()) | {"second_look": {"after": after, "least": least, "unless": unless}}
path.write_text(json.dumps(stored, indent=2) + "\n")' "$@"
}

take_counsel() {  # a PONDER's folder is served in OTHER views too, each of them DOWN,RIGHT or DOWN,RIGHT,mirrored; on `all`
    # episodes, or on `others` than those with a demonstration
    "$bin/python" -c 'import json, pathlib, sys
path, others = pathlib.Path(sys.argv[1], "ponder.json"), [each.split(",") for each in sys.argv[3:]]
views = [{"down_px": int(down), "right_px": int(right), "is_mirrored": bool(mirrored)} for down, right, *mirrored in others]
stored = json.loads(path.read_text()) | {"counsel": {"others": views, "near": 30, "on_demonstrations": sys.argv[2] == "all"}}
path.write_text(json.dumps(stored, indent=2) + "\n")' "$@"
}

take_none() {  # a PONDER's folder is served in its own view alone
    "$bin/python" -c 'import json, pathlib, sys
path = pathlib.Path(sys.argv[1], "ponder.json")
path.write_text(json.dumps(json.loads(path.read_text()) | {"counsel": None}, indent=2) + "\n")' "$@"
}

give_reader() {  # a PONDER gets a reader of demonstrations, which reads as ANOTHER does, INTO a folder
    mkdir -p "$3"
    cp "$1"/* "$3"
    "$bin/python" -c 'import json, pathlib, sys
from safetensors.torch import load_file, save_file
weights, into = load_file(pathlib.Path(sys.argv[2], "model.safetensors")), pathlib.Path(sys.argv[3])
own = {name.removeprefix("model.language_model."): weight for name, weight in weights.items()}
save_file({name: own[name] for name in own if name.startswith("layers.") or name == "norm.weight"}, into / "reader.safetensors")
stored = json.loads((into / "ponder.json").read_text()) | {"format": "ponderpounce.ponder/10", "has_reader": True}
stored = {"fovea": None, "demonstrations": {"hz": 2, "to_its_end": True}} | stored  # as the other was shown them
(into / "ponder.json").write_text(json.dumps(stored, indent=2) + "\n")' "$@"
}

narrow_reader() {  # a PONDER's reader INTO another's folder, in its first LAYERS and in few BITS, as it has learned to be
    "$bin/python" -c 'import pathlib, sys
from dual_system.models.ponder.checkpoint import READER_NAME, load_ponder
from dual_system.models.reader_file import Narrowing, write_reader
ponder, narrowing = load_ponder(pathlib.Path(sys.argv[1])), Narrowing(num_layers=int(sys.argv[3]), bits=int(sys.argv[4]))
write_reader(ponder.reader, ponder.qwen.model.language_model, pathlib.Path(sys.argv[2], READER_NAME), narrowing)' "$@"
}

give_specialist() {  # a PONDER's NAMED specialist INTO another's folder, in its first LAYERS and in few BITS, as it has learned to be
    "$bin/python" -c 'import json, pathlib, sys
from dataclasses import asdict
from dual_system.models.ponder.checkpoint import load_ponder, specialist_name
from dual_system.models.reader_file import Narrowing, write_reader
ponder, path = load_ponder(pathlib.Path(sys.argv[1])), pathlib.Path(sys.argv[2], "ponder.json")
(specialty,) = (each for each in ponder.format.specialties if each.name == sys.argv[3])
narrowing = Narrowing(num_layers=int(sys.argv[4]), bits=int(sys.argv[5]))
own, text_model = ponder.specialists[specialty.name], ponder.qwen.model.language_model
write_reader(own, text_model, path.with_name(specialist_name(specialty)), narrowing)
stored = json.loads(path.read_text())
if "specialties" not in stored: stored |= {"specialties": [], "format": "ponderpounce.ponder/11"}
stored["specialties"] = [each for each in stored["specialties"] if each["name"] != specialty.name] + [asdict(specialty)]
path.write_text(json.dumps(stored, indent=2) + "\n")' "$@"
}

grip_firmly() {  # both of a PAIR are told fingers between STRAIGHT and ASKEW, in metres of one, as if they were at the first
    "$bin/python" -c 'import json, pathlib, sys
pair, grip = pathlib.Path(sys.argv[1]), {"straight_m": float(sys.argv[2]), "askew_m": float(sys.argv[3])}
ponder, pounce = json.loads((pair / "ponder/ponder.json").read_text()), json.loads((pair / "pounce/config.json").read_text())
ponder["proprioception"]["grip"] = pounce["statistics"]["grip"] = grip
(pair / "ponder/ponder.json").write_text(json.dumps({"specialties": []} | ponder | {"format": "ponderpounce.ponder/12"}, indent=2) + "\n")
(pair / "pounce/config.json").write_text(json.dumps(pounce, indent=1) + "\n")' "$@"
}

pack() {  # the weights of a PONDER's folder, without loss
    "$bin/python" -c 'import pathlib, sys
from dual_system.models.packed import pack
from dual_system.models.ponder.checkpoint import PACKED_NAME, SINGLE_NAME
path = pathlib.Path(sys.argv[1], SINGLE_NAME)
path.with_name(PACKED_NAME).write_bytes(pack(path.read_bytes()))
path.unlink()' "$@"
}

blend() {  # two PONDERs' weights, a SHARE of the second's, INTO a folder
    mkdir -p "$4"
    cp "$1"/* "$4"
    "$bin/python" -c 'import pathlib, sys
from safetensors.torch import load_file, save_file
one, other = (load_file(pathlib.Path(folder, "model.safetensors")) for folder in sys.argv[1:3])
share, path = float(sys.argv[3]), pathlib.Path(sys.argv[4], "model.safetensors")
blended = {name: weight.float() * (1 - share) + other[name].float() * share for name, weight in one.items()}
save_file(blended, path, metadata={"format": "pt"})' "$@"
}

evaluate() {  # a PAIR on the test scenes of fifteen tasks and of OTHERS (and as pp-eval is told), with cognition and without: OUT/real, OUT/null, OUT/tables
    local pair=$1 out=$2 cognition
    for cognition in real null; do
        "$bin/pp-eval" --tasks PickHighlight StopCube MoveCube PatternLock RouteStick VideoPlaceButton VideoPlaceOrder VideoRepick \
            ButtonUnmask VideoUnmask PickXtimes SwingXtimes BinFill ButtonUnmaskSwap VideoUnmaskSwap "${@:3}" --episodes 50 --runs 1 \
            --seed 1000 --workers 2 --cognition "$cognition" --ponder-checkpoint "$pair/ponder" --pounce-checkpoint "$pair/pounce" \
            --out "$out/$cognition"
    done
    "$bin/pp-tables" "$out/real" "$out/null" --out "$out/tables"
}
