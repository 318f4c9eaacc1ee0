"""Module names in the config.yml files of earlier runs and bundles: `bitymi_ns.host` is `bitymi_ns.plugin` now."""

import importlib
import sys

_RENAMED = {
    **{name: f"data.{name}" for name in ("datamanager", "dataparser", "dataset")},
    **{name: f"run.{name}" for name in ("bundle_model", "config", "model", "surfel_model", "trainer")},
    "bundle_config": "run.bundle_model",
    "pipeline": "run.trainer",
}

for _old, _new in _RENAMED.items():
    sys.modules[f"{__name__}.{_old}"] = importlib.import_module(f"bitymi_ns.plugin.{_new}")
