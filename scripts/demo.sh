#!/usr/bin/env bash
# Train, bake, evaluate and report: the sample room, or your own capture.
#
#   scripts/demo.sh [DATA]     DATA: as for `ns-train bitymi --data`: photographs, a video, a COLMAP project, or a
#                              capture with transforms.json
#
# Needs the commands on PATH: run by `make demo` after `make setup`, or in an environment with this package installed.
# Steps whose results exist are skipped; remove a result to compute it again. An interrupted training resumes from its
# last checkpoint. METHOD (default bitymi) and STEPS (default: the method's own) select the method and length.
set -euo pipefail
[ $# -eq 0 ] || data=$(realpath -- "$1" 2>/dev/null) || data=
cd "$(dirname "${BASH_SOURCE[0]}")/.."

method=${METHOD:-bitymi}
if [ $# -ge 1 ]; then
  [ -e "$data" ] || {
    echo "demo: $1 does not exist" >&2
    exit 1
  }
  name=$(basename -- "$data")
  out=demo/capture-$name
else
  name=demo
  out=demo
  data=$PWD/demo/data
fi
[ "$method" = bitymi ] || out=$out/$method
run=$out/outputs/$name/$method/run
options=()
[ -z "${STEPS:-}" ] || options=(--max-num-iterations "$STEPS")
asked="$data ${STEPS:-}" # identifies the results in $out

# nerfstudio 1.1.5 imports deprecated names of torch before the plugin is loaded
export PYTHONWARNINGS=${PYTHONWARNINGS:-ignore::FutureWarning:nerfstudio.field_components.activations}

say() { printf '\n== %s (%d s so far)\n' "$*" "$SECONDS"; }

if [ $# -eq 0 ] && [ ! -f "$data/transforms.json" ]; then
  say "Rendering the sample room into $data"
  bitymi sample --output-dir "$data"
fi

if [ ! -f "$run/finished" ] || [ "$(cat "$run/asked" 2>/dev/null)" != "$asked" ]; then
  say "Training $method on $data"
  rm -rf "$run/finished" "$out/bundle" "$out/renders" "$out/report" "$out"/eval-*.json
  if [ "$(cat "$run/asked" 2>/dev/null)" = "$asked" ] && compgen -G "$run/nerfstudio_models/*.ckpt" >/dev/null; then
    options+=(--load-dir "$run/nerfstudio_models")
  else
    rm -rf "$run"
    mkdir -p "$run"
    printf '%s\n' "$asked" >"$run/asked"
  fi
  ns-train "$method" --data "$data" --output-dir "$out/outputs" --experiment-name "$name" --timestamp run \
    --vis tensorboard "${options[@]}"
  touch "$run/finished"
fi

if [ ! -f "$out/bundle/bundle.json" ]; then
  say "Baking into $out/bundle"
  ns-export bitymi-atlas --load-config "$run/config.yml" --output-dir "$out/bundle"
  rm -rf "$out/eval-baked.json" "$out/renders/baked"
fi

if [ ! -f "$out/eval-trained.json" ]; then
  say "Evaluating the trained model"
  ns-eval --load-config "$run/config.yml" --output-path "$out/eval-trained.json" \
    --render-output-path "$out/renders/trained"
fi

if [ ! -f "$out/eval-baked.json" ]; then
  say "Evaluating the bundle"
  ns-eval --load-config "$out/bundle/config.yml" --output-path "$out/eval-baked.json" \
    --render-output-path "$out/renders/baked"
fi

say "Writing the report"
bitymi report "$out/eval-trained.json" "$out/eval-baked.json" "$run" "$out/renders" --output-dir "$out/report"

view=bitymi
[ ! -x .venv/bin/bitymi ] || view=.venv/bin/bitymi

cat <<END

Done in $SECONDS s.
  report    $out/report/index.html
  bundle    $out/bundle             (ns-viewer --load-config $out/bundle/config.yml)
  renders   $out/renders            held-out views, of the trained model and of the bundle
  model     $run

Look at it in the browser:   $view view $out/bundle
A page for any web server:   $view view $out/bundle --export $out/page
END
