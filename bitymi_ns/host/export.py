"""ns-export bitymi-atlas."""

from dataclasses import dataclass
from pathlib import Path


@dataclass
class ExportAtlas:
    """Bake."""

    load_config: Path
    output_dir: Path
