#!/usr/bin/env bash
# Train in slices on a machine that keeps nothing: draw pairs, train, validate and save under $OUT, in one call.
#
#   OUT=out scripts/train_on_gpu.sh --config config/train_paper.yaml --anatomy DIR [options of gapr train]
#   OUT=out2 RESUME=out scripts/train_on_gpu.sh ...the same options...       # the next slice goes on from the last
#
# MINUTES (8) of training; validation and saving take about one more. WORKERS draw pairs (all cores but two).
# $OUT gets at most 8 files of at most 15 MiB: the checkpoint in pieces, the averaged weights, logs and curves.
# A network of 2.3 M parameters has a checkpoint of 37 MB; the paper's full size (11.7 M, 190 MB) does not fit.
# Bones without a mesh in DIR (thoracic cartilage) are drawn with Open3D, as are one-sided views: without Open3D
# train protocol paper with --set 'bones=[femur,tibia,pelvis]'.
set -euo pipefail
cd "$(dirname "$0")/.."
: "${OUT:?set OUT to the folder that outlasts this call}"
PYTHON=${PYTHON:-python3}
MINUTES=${MINUTES:-8}
CORES=$(nproc)
WORKERS=${WORKERS:-$(( CORES > 3 ? CORES - 2 : 1 ))}
RUN=${RUN:-$(mktemp -d)/run}
PIECE=15M
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} MPLBACKEND=Agg OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}

if [ -n "${RESUME:-}" ] && [ ! -f "$RESUME/run.tar.gz" ]; then
  echo "train_on_gpu: expected the OUT of an earlier slice as RESUME; got $RESUME without run.tar.gz;" \
    "correct the path, or leave RESUME out to start from nothing" >&2
  exit 1
fi
mkdir -p "$OUT" "$RUN"
if [ -n "${RESUME:-}" ]; then
  tar xzf "$RESUME/run.tar.gz" -C "$RUN"
  cat "$RESUME"/checkpoint.part_* > "$RUN/checkpoint.safetensors"
  sha256sum --quiet --check <(sed "s|  .*|  $RUN/checkpoint.safetensors|" "$RESUME/checkpoint.sha256")
fi

"$PYTHON" -m gapr_core.cli train --out "$RUN" --minutes "$MINUTES" --workers "$WORKERS" "$@"

rm -f "$OUT"/checkpoint.part_*
split --bytes=$PIECE --numeric-suffixes "$RUN/checkpoint.safetensors" "$OUT/checkpoint.part_"
sha256sum "$RUN/checkpoint.safetensors" > "$OUT/checkpoint.sha256"
cp "$RUN/weights.safetensors" "$OUT/"
tar czf "$OUT/run.tar.gz" -C "$RUN" --exclude=checkpoint.safetensors --exclude=weights.safetensors .
if [ "$(ls "$OUT" | wc -l)" -gt 8 ] || [ "$(du -sm "$OUT" | cut -f1)" -gt 64 ]; then
  echo "train_on_gpu: $OUT holds more than 8 files or 64 MiB: choose a smaller network" >&2
  exit 1
fi
tail -n 1 "$RUN/log.csv"
grep ',all,' "$RUN/validation.csv" | tail -n 1 || true
