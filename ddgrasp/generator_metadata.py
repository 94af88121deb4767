"""What an exported generator says about itself, written by export and read by deploy. No JAX, no ONNX."""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ddgrasp.errors import UserError
from ddgrasp.files import DAMAGED_JSON

METADATA_KEY = "ddgrasp_generator"
"""metadata_props key whose value is a JSON object of `GeneratorMetadata`."""
FORMAT = 1
"""Raised when inputs or outputs change their meaning."""
INPUT_DEPTH = "depth"
"""(B, H, W) float32 planar metres, 0 = nothing in range; any H and W of the generator's shape."""
INPUT_NOISE = "noise"
"""(B, P, h, w) float32, standard normal, at the generator's size: a plane for the prior, C for the start, and
for a stochastic sampler C more for every evaluation but the last."""
INPUT_STEPS = "steps"
"""int64 scalar, network evaluations. A distilled generator has no such input."""
OUTPUT_DEPTH = "reported"
"""(B, H, W) float32 metres, 0 = hole: simulated depth with the camera's artefacts grafted."""
OUTPUT_PREDICTED = "predicted"
"""(B, H, W) the generator's own map."""
OUTPUT_MASK = "mask"
"""(B, H, W) bool, where an artefact was grafted."""
ASPECT_TOLERANCE = 0.02
"""Simulated depth is of the generator's shape, but for this share."""
FARTHEST_SANE_M = 200.0
"""Simulated depth beyond this is in another unit."""
REMEDY = "make one with `ddgrasp ddg export`"


@dataclass(frozen=True)
class GeneratorMetadata:
    """Contents of metadata_props[METADATA_KEY]."""

    format: int
    project_version: str
    height_px: int
    """Rows of the map inside, and of the noise."""
    width_px: int
    channels: int
    """C, planes of noise for one evaluation."""
    sampler: str
    steps: int
    """Network evaluations that it was fitted for."""
    most_steps: int
    """Evaluations that can be asked for; `steps` for a distilled generator."""
    stochastic: bool
    """Whether every evaluation but the last takes fresh noise."""
    frame_correlation: float
    """Share of the noise's variance that frames of an episode should have in common."""
    deviation_correlation: float
    """The same for the last channel of the start, if C is 2."""
    unit: str
    """What depth is measured in."""
    camera: dict[str, Any] = field(default_factory=dict)
    """What it was fitted on: name, width_px, height_px, fx_px, near_m, far_m (of readings), where known."""
    knows_position: bool = False
    """Whether it knows where in the picture a pixel is: it draws one camera then, upright and as it stood."""
    licence: str = ""
    source: str = ""
    """Where the recordings come from, in words."""
    manifest_hash: str = ""
    """Names the stage that it was exported from."""

    @property
    def fixed_steps(self) -> bool:
        """Whether the file has no input for the number of evaluations."""
        return self.most_steps == self.steps and self.sampler == "progressive"

    def planes(self, steps: int) -> int:
        """P, planes of noise that `steps` evaluations take."""
        return 1 + self.channels * (steps if self.stochastic else 1)

    def to_json(self) -> str:
        """The value of the metadata property."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)


def read(properties: Mapping[str, str], source: str) -> GeneratorMetadata:
    """The metadata of a file with these metadata_props; UserError if it is no generator, or a later one.

    Args:
      properties: onnxruntime's `get_modelmeta().custom_metadata_map`.
      source: the file's name, for messages.
    """
    if METADATA_KEY not in properties:
        raise UserError(f"{source} is no generator of this project: {REMEDY}.")
    try:
        raw = json.loads(properties[METADATA_KEY])
        known = {one.name for one in dataclasses.fields(GeneratorMetadata)}
        metadata = GeneratorMetadata(**{key: value for key, value in raw.items() if key in known})
    except (AttributeError, TypeError, *DAMAGED_JSON) as error:
        raise UserError(f"{source} has damaged metadata ({error}): {REMEDY}.") from None
    if metadata.format != FORMAT:
        raise UserError(
            f"{source} is a generator of format {metadata.format}, this code reads {FORMAT}: {REMEDY}."
        )
    return metadata
