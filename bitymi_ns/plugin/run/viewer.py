"""ns-viewer on our scenes: for this machine alone unless it is told otherwise, and ended by Ctrl-C."""

from __future__ import annotations

import sys
from typing import Any

from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.utils.rich_utils import CONSOLE

LOOPBACK = "127.0.0.1"
"""The address that only this machine can reach. nerfstudio's default, 0.0.0.0, is open to the network."""
HOST_OPTION = "--viewer.websocket-host"
SCRIPTS = ("nerfstudio.scripts.viewer.run_viewer", "__main__")


def adopt_viewer(config: Any) -> None:
    """Have ns-viewer, where it is the command that loads `config`, show this scene by our rules.

    ns-viewer replaces the recorded viewer options by those of its own command line, so config.yml cannot set the host;
    and it waits for Ctrl-C in a loop that ends in a traceback. Both are put right around its `_start_viewer`.
    """
    for name in SCRIPTS:
        script = sys.modules.get(name)
        start = getattr(script, "_start_viewer", None)
        if start is not None:
            script._start_viewer = _ours_for(config, start)  # type: ignore[union-attr]


def _ours_for(config: Any, start: Any) -> Any:
    def start_viewer(shown: Any, *args: Any) -> None:
        if shown is not config:
            start(shown, *args)
            return
        for pipeline in args[:1]:  # photographs that are gone are no hindrance to it
            for name in ("train_dataset", "eval_dataset"):
                dataset = getattr(getattr(pipeline, "datamanager", None), name, None)
                if dataset is not None:
                    dataset.gray_images = True
        if shown.viewer.websocket_host == ViewerConfig().websocket_host and not _host_given():
            shown.viewer.websocket_host = LOOPBACK
        CONSOLE.print("Ctrl-C ends the viewer.")
        try:
            start(shown, *args)
        except KeyboardInterrupt:
            CONSOLE.print("\nThe viewer has ended.")

    return start_viewer


def _host_given() -> bool:
    return any(argument.partition("=")[0].replace("_", "-") == HOST_OPTION for argument in sys.argv)
