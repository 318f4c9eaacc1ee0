"""A process of a run as a program: part_of_a_run.py FOLDER RANK COUNT; and saving and restoring a run's state."""

import copy
import hashlib
import sys
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import DensifyConfig, ExposureKind, RefinePoses, TexelConfig, TrainConfig
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.processes import Processes, ProcessLost

STEPS = 60
LOST = 3


def options(exposure: ExposureKind, poses: RefinePoses) -> TrainConfig:
    """Configure densification, a reset, final prunes, and texels from step 36 on."""
    densify = DensifyConfig(
        max_surfels=300, min_interval=1, min_reset_interval=1, pixels_per_surfel=0, views=5, reset_interval=9_000
    )
    return TrainConfig(
        densify=densify, background="random", exposure=exposure, texels=TexelConfig(start=18_000), refine_poses=poses
    )


def state_of(trainer: Trainer) -> dict[str, Any]:
    """Collect the state for an exact resume."""
    scene, optimizers = trainer.scene.state_dict(), trainer.optimizers
    return copy.deepcopy(
        {
            "step": trainer.step,
            "scene": {name: value.detach() for name, value in scene.items()},
            "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.items()},
            "training": trainer.training.state_dict(),
        }
    )


def resume(trainer: Trainer, state: dict[str, Any]) -> None:
    """Restore `state_of`; the run has the same options, views and length."""
    trainer.scene.resize_for_state(state["scene"])
    trainer.scene.load_state_dict(state["scene"])
    for name, optimizer in trainer.optimizers.items():
        optimizer.load_state_dict(copy.deepcopy(state["optimizers"][name]))
    trainer.training.load_state_dict(state["training"])
    trainer.step = state["step"]


def advanced(trainer: Trainer, steps: int) -> Trainer:
    """Train for some more steps; returns the trainer."""
    for _ in range(steps):
        trainer.advance()
    return trainer


def train(inputs: dict[str, Any], processes: Processes) -> dict[str, Any]:
    """Train; returns the final state, and digests of all parameters every ten steps."""
    config, field = SceneConfig(texture=inputs["texture"]), None
    if config.texture == "hash":
        field = HashField(config, (0.0, 0.0, 0.0), 1.5, False, 10, torch.Generator().manual_seed(processes.rank))
    trainer = Trainer(
        Scene(config, inputs["surfels"], field),
        inputs["views"],
        options(inputs["exposure"], inputs["poses"]),
        STEPS,
        processes,
    )
    digests, reports = [], []
    while trainer.step < STEPS:
        *_, report = trainer.advance()
        reports.append(report)
        if trainer.step % 10 == 0:
            bits = [value.numpy().tobytes() for value in trainer.scene.state_dict().values()]
            digests.append(hashlib.sha256(b"".join(bits)).hexdigest())
    return {"digests": digests, "reports": reports, "state": state_of(trainer)}


def main() -> None:
    folder, rank, count = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    torch.set_num_threads(1)
    inputs = torch.load(folder / "inputs.pt", weights_only=False)
    dist.init_process_group(
        "gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=count, timeout=timedelta(seconds=60)
    )
    try:
        result = train(inputs, Processes.joined())
    except ProcessLost as error:
        print(error, file=sys.stderr)
        dist.destroy_process_group()
        sys.exit(LOST)
    torch.save(result, folder / f"end-{rank}.pt")
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
