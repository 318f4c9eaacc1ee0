"""ns-train with far too high learning rates gives a message and a usable scene."""

from collections.abc import Callable

import torch
from nerfstudio.scripts import train as ns_train

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run.config import BitymiTrainerConfig as Run
from tests.typed import Printed


def test_a_diverging_run_leaves_a_finite_scene(start: Callable[..., Run], capsys: Printed) -> None:
    config = start()
    train = config.pipeline.model.train
    train.lr = train.lr.times(1000.0)
    config.max_num_iterations = 100
    message = ""
    try:
        ns_train.main(config)
    except InputError as error:
        message = str(error)
        assert "training cannot go on" in message and "lower learning rates" in message
    said = " ".join((capsys.readouterr().out + message).split())
    assert "training diverged" in said
    for path in sorted(config.get_checkpoint_dir().glob("*.ckpt")):
        state = torch.load(path, weights_only=True)["pipeline"]
        for name, value in state.items():
            if isinstance(value, torch.Tensor):
                assert value.isfinite().all(), (path.name, name)
