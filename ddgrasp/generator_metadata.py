"""What an exported generator says about itself, written by export and read by deploy. No JAX, no ONNX."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ddgrasp.errors import UserError
from ddgrasp.files import DAMAGED_JSON, is_number

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
_MOST = {"height_px": 4096, "width_px": 4096, "channels": 2, "most_steps": 1000}
"""Whole numbers from 1 on, and the most that each may be: the noise of a frame would be gigabytes else."""
_CAMERA_NUMBERS = ("width_px", "height_px", "fx_px", "near_m", "far_m")


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
    """The metadata of a file with these metadata_props; UserError if it is no generator, a later one, or says
    what none can be.

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
    if type(metadata.format) is not int or metadata.format != FORMAT:
        raise UserError(
            f"{source} is a generator of format {metadata.format!r}, this code reads {FORMAT}: {REMEDY}."
        )
    _check_values(metadata, source)
    return metadata


def validate_shapes(
    metadata: GeneratorMetadata, shapes: Mapping[str, Sequence[int | str | None]], source: str
) -> None:
    """UserError unless the graph's inputs (name -> shape) are those of its metadata; `source` is its file.

    The noise's planes may be a symbolic size: how many there are depends on the evaluations asked for.
    """
    takes = {INPUT_DEPTH, INPUT_NOISE} | (set() if metadata.fixed_steps else {INPUT_STEPS})
    if shapes.keys() != takes:
        raise UserError(
            f"{source} has the inputs {', '.join(sorted(shapes))}, its metadata says "
            f"{', '.join(sorted(takes))}: {REMEDY}."
        )
    there, planes = list(shapes[INPUT_NOISE]), metadata.planes(metadata.steps)
    size = [planes, metadata.height_px, metadata.width_px]
    free = len(there) == 4 and not isinstance(there[1], int)
    if there[1:] != ([there[1], *size[1:]] if free else size):
        raise UserError(
            f"{source}: {INPUT_NOISE!r} has shape {there}, its metadata says {['batch', *size]}: {REMEDY}."
        )


def _check_values(metadata: GeneratorMetadata, source: str) -> None:
    for name, most in (*_MOST.items(), ("steps", metadata.most_steps)):
        value = getattr(metadata, name)
        if type(value) is not int or not 1 <= value <= most:
            raise UserError(f"{source}: {name} is {value!r}, expected 1 to {most}: {REMEDY}.")
    for name in ("frame_correlation", "deviation_correlation"):
        value = getattr(metadata, name)
        if not is_number(value) or not 0 <= value <= 1:
            raise UserError(f"{source}: {name} is {value!r}, expected 0 to 1: {REMEDY}.")
    for name in ("stochastic", "knows_position"):
        if not isinstance(value := getattr(metadata, name), bool):
            raise UserError(f"{source}: {name} is {value!r}, expected true or false: {REMEDY}.")
    if not isinstance(metadata.camera, dict):
        raise UserError(f"{source}: camera is {metadata.camera!r}, expected what is known of it: {REMEDY}.")
    for name in _CAMERA_NUMBERS:
        if (value := metadata.camera.get(name)) is not None and not is_number(value):
            raise UserError(f"{source}: camera's {name} is {value!r}, expected a number: {REMEDY}.")
