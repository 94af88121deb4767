"""The networks whose published weights fit here: what they are, where they are published, under which
licence.
"""

from dataclasses import dataclass

from ddgrasp.errors import looked_up
from foundation.sizes import SIZES

IMAGE_DEPTH = "depth_anything_v2"
VIDEO_DEPTH = "video_depth_anything"
RESNET18 = "resnet18"
FID_INCEPTION = "fid_inception"

_APACHE = "Apache-2.0"
_NON_COMMERCIAL = "CC-BY-NC-4.0 (non-commercial)"


@dataclass(frozen=True)
class Entry:
    """One network with published weights."""

    name: str
    file: str
    """The published file's name."""
    published: str
    """Who publishes it, and where."""
    licence: str
    """Licence of the weights."""
    used_for: str


def _depth(family: str, size: str, published: str, file: str, used_for: str) -> Entry:
    licence = _APACHE if size == "small" else _NON_COMMERCIAL
    return Entry(f"{family}_{size}", file, published, licence, used_for)


ENTRIES = {
    entry.name: entry
    for entry in (
        *(
            _depth(
                VIDEO_DEPTH,
                size,
                f"Hugging Face, depth-anything/Video-Depth-Anything-{size.capitalize()}",
                f"video_depth_anything_vit{size[0]}.pth",
                "the generator's prior (--ddg.prior.source video_depth_anything)",
            )
            for size in SIZES
        ),
        *(
            _depth(
                IMAGE_DEPTH,
                size,
                f"Hugging Face, depth-anything/Depth-Anything-V2-{size.capitalize()}",
                f"depth_anything_v2_vit{size[0]}.pth",
                "the generator's prior (--ddg.prior.source depth_anything_v2), `ddg score --monocular`, "
                "--student.depth-source monocular, `deploy trials --depth monocular`",
            )
            for size in SIZES
        ),
        Entry(
            RESNET18,
            "resnet18-f37072fd.pth",
            "torchvision, ResNet18_Weights.IMAGENET1K_V1",
            "none of its own; torchvision's code is BSD-3-Clause, trained on ImageNet under its terms",
            "the student's first encoder weights (--student.encoder.weights), features for metrics",
        ),
        Entry(
            FID_INCEPTION,
            "pt_inception-2015-12-05-6726825d.pth",
            "GitHub, mseitzer/pytorch-fid, release fid_weights",
            "Apache-2.0, as pytorch-fid; converted from TensorFlow's graph of 2015-12-05",
            "features for FID and KID",
        ),
    )
}


def get_entry(name: str) -> Entry:
    """The entry called `name`; UserError with the nearest name otherwise."""
    return looked_up("network", name, ENTRIES)
