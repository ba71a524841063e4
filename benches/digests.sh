#!/usr/bin/env bash
# Short runs of every preset with one binary, and a digest of the tensors of each final checkpoint: two builds that train the same bits print the
# same lines. About five minutes on two cores.
#
#     benches/digests.sh target/release/plenoxel OUT data/nerf_synthetic/lego
#
# Without a third argument the runs on lego are left out. Needs Python 3 for the digests.
set -euo pipefail
binary=$1 out=$2 lego=${3:-}
mkdir -p "$out"
quiet=(--no-images --no-report --preview-every off --quiet)
run() { local name=$1; shift; "$binary" "$@" --out "$out/$name" --force > "$out/$name.log" 2>&1 || { echo "failed: $name"; tail -1 "$out/$name.log"; }; }
scene=(--scene-size 100 --scene-views 40,4,2)
run demo train "${scene[@]}" --preset demo --set 'stages[*].steps=80' "${quiet[@]}"
run fast train "${scene[@]}" --preset fast --set 'stages[*].steps=60' "${quiet[@]}"
run paper train "${scene[@]}" --preset paper --downscale 2 --set 'stages[*].steps=60' "${quiet[@]}"
run voxels train "${scene[@]}" --preset voxels --set 'stages[*].steps=60' "${quiet[@]}"
run plenoxels train "${scene[@]}" --preset plenoxels --set 'stages[*].steps=60' --set 'stages[0].resolution=64' --set 'stages[1].resolution=128' "${quiet[@]}"
if [ -n "$lego" ]; then
    run fast-lego train "$lego" --downscale 2 --preset fast --hull off --set 'stages[*].steps=50' "${quiet[@]}"
    run voxels-lego train "$lego" --downscale 2 --preset voxels --set 'stages[*].steps=30' --set 'scout.stages[*].steps=30' --hull off "${quiet[@]}"
    run carve carve "$lego" --downscale 4 --resolution 128 --sh-degree 2 --no-images --no-report --quiet
    run carve-init train "$lego" --downscale 4 --init-from "$out/carve" --preset fast --set 'stages[*].steps=30' "${quiet[@]}"
fi
python3 - "$out"/*/checkpoint.safetensors <<'PYTHON'
import hashlib, json, struct, sys
for path in sys.argv[1:]:
    data = open(path, "rb").read()
    (n,) = struct.unpack("<Q", data[:8])
    tensors = {k: v for k, v in json.loads(data[8 : 8 + n]).items() if k != "__metadata__"}
    digest = hashlib.sha256()
    for name, info in sorted(tensors.items()):
        a, b = info["data_offsets"]
        digest.update(f"{name} {info['dtype']} {info['shape']}\n".encode() + data[8 + n + a : 8 + n + b])
    print(digest.hexdigest()[:16], path.split("/")[-2])
PYTHON
