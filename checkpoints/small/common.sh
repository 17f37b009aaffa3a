# What the scripts beside it have in common; each sets $bin.

logs() {  # of finished episodes that were played into FOLDER, all or with a STATUS: a kill leaves the beginning of one more
    "$bin/python" -c 'import json, pathlib, sys
folder, *wanted = sys.argv[1:]
for each in json.loads(pathlib.Path(folder, "results.json").read_text())["episodes"]:
    if each["status"] in (wanted or [each["status"]]):
        print(pathlib.Path(folder, each["mcap"]))' "$@"
}

correct() {  # the oracle takes over the episodes that were played into FOLDER and ended with a STATUS, each so many TIMES
    local folder=$1 status=$2 times=$3 out=$4 found
    mapfile -t found < <(logs "$folder" "$status")
    if [ ${#found[@]} -gt 0 ] && [ ! -d "$out/meta" ]; then
        rm -rf "$out"  # a kill left the beginning
        "$bin/pp-correct" "${found[@]}" --order near-first --per-episode "$times" --out "$out"
    fi
}

halve() {  # a PONDER's or a POUNCE's folder INTO another, its weights in half precision
    local folder=$1 into=$2
    mkdir -p "$into"
    cp "$folder"/* "$into"
    "$bin/python" -c 'import pathlib, sys
from safetensors.torch import load_file, save_file
for path in pathlib.Path(sys.argv[1]).glob("*.safetensors"):  # a reader has its own
    save_file({name: tensor.half() for name, tensor in load_file(path).items()}, path, metadata={"format": "pt"})' "$into"
}

collect() {  # into a folder, the oracle's way with these options
    local into=$1; shift
    [ -d "$into/meta" ] || "$bin/pp-collect" --frames training --invocation-hz 5 --difficulties easy medium hard \
        --order near-first --texts follow --noise dart --out "$into" "$@"
}
