"""Run COLMAP in this process: a Job on stdin, lines of JSON on stdout, {"stage", "done", "total", "counts"}, or
at the end {"result"} or {"failure"}. The process ends with its stdin. Prints of libraries go to stderr."""

import json
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pycolmap  # with its signal handlers, which log the stack of a crash

from bitymi_ns.files import complete_folder, write_errors_as
from ..colmap_model import write_model
from . import mapping, matching, model_checks
from .job import DATABASE, MODEL, Job, NoPoses

LEAST = 3  # placed photographs of a capture
_messages = sys.__stdout__  # the pipe of messages


class Stages:
    """Sender of progress that times every stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._since = time.monotonic()
        self._stage = "starting"

    def __call__(self, stage: str, done: int, total: int, counts: str = "") -> None:
        now = time.monotonic()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now
        send(stage=stage, done=done, total=total, counts=counts)


def send(**line: object) -> None:
    print(json.dumps(line), file=_messages, flush=True)


def find(job: Job, stages: Stages) -> tuple[pycolmap.Reconstruction, dict[str, object]]:
    """Find poses of a job's photographs; return the model and statistics. Raises NoPoses."""
    database = Path(job.work) / DATABASE
    matching.extract(job, database, stages)
    matching.match(job, database, stages)
    graph, model = _mapped(job, database, stages)
    registered = model.num_reg_images() if model is not None else 0
    chosen = matching.FEW < len(job.order) <= matching.WORTH_ALL and job.matching == "auto"
    if chosen and registered < mapping.ENOUGH * len(job.order):
        matching.match(job, database, stages, every=True)
        graph, again = _mapped(job, database, stages)
        model = mapping.better(job, database, model, again)
    if model is None or model.num_reg_images() < LEAST:
        raise model_checks.why_none(job, graph)
    angle = model_checks.parallax(model)
    if angle < model_checks.PARALLAX:
        raise NoPoses(model_checks.FROM_ONE_SPOT)
    placed = {image.name for image in model.images.values() if image.has_pose}
    model.extract_colors_for_all_images(job.images)
    return model, {
        "registered": len(placed),
        "reprojection_error": model.compute_mean_reprojection_error(),
        "track_length": model.compute_mean_track_length(),
        "points": model.num_points3D(),
        "parallax_degrees": angle,
        "contradicted": model_checks.contradicted(model, database, job.pixel),
        "pairs": len(graph.inliers),
        "left_out": model_checks.left_out(graph, placed, job.names),
    }


def _mapped(job: Job, database: Path, stages: Stages) -> tuple[model_checks.ViewGraph, pycolmap.Reconstruction | None]:
    graph = model_checks.view_graph(database)
    parts = graph.components()
    if model_checks.only_turned(job, database):
        raise NoPoses(model_checks.FROM_ONE_SPOT)
    if not parts or len(parts[0]) < LEAST:
        return graph, None
    return graph, mapping.reconstruct(job, database, len(parts[0]), stages)


def main() -> None:
    """Run a job, and write its model under the photographs' own names."""
    global _messages
    _messages = os.fdopen(os.dup(1), "w", encoding="utf8")
    os.dup2(2, 1)  # OpenBLAS prints warnings to stdout
    job = Job.parse(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pycolmap.logging.minloglevel = 1  # warnings and errors
    for level in pycolmap.logging.Level.__members__.values():
        pycolmap.logging.set_log_destination(level, "")  # no files in the temporary folder
    np.seterr(all="ignore")
    stages = Stages()
    try:
        model, result = (mapping.triangulate(job, stages), {}) if job.poses else find(job, stages)
        for image in model.images.values():
            image.name = job.names[image.name]
        path = Path(job.work) / MODEL
        with (
            write_errors_as(path, NoPoses, ". Start again then: what is done is kept."),
            complete_folder(path) as folder,
        ):
            write_model(model, folder)
        stages("writing", 1, 1)
        send(result={**result, "seconds": {k: v for k, v in stages.seconds.items() if k != "starting"}})
    except NoPoses as failure:
        send(failure=str(failure))


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(1)
