"""Small, Base and Large of the depth networks: values only, one set for the image and the video network."""

from dataclasses import dataclass

from ddgrasp.errors import looked_up

PATCH_PX = 14
"""Side of a ViT patch; picture sides are multiples of it."""
HEAD_SIZE = 64
"""Channels per attention head."""


@dataclass(frozen=True)
class DepthSize:
    """One size of Depth Anything V2 and of Video Depth Anything."""

    name: str
    width: int
    """Channels of a ViT token."""
    blocks: int
    """ViT blocks."""
    taps: tuple[int, int, int, int]
    """Blocks (from 0) whose outputs the head reads."""
    features: int
    """Channels of the head's fusion."""
    channels: tuple[int, int, int, int]
    """Channels of the four maps before the fusion, finest first."""

    @property
    def heads(self) -> int:
        """Attention heads per ViT block."""
        return self.width // HEAD_SIZE


SIZES = {
    size.name: size
    for size in (
        DepthSize("small", 384, 12, (2, 5, 8, 11), 64, (48, 96, 192, 384)),
        DepthSize("base", 768, 12, (2, 5, 8, 11), 128, (96, 192, 384, 768)),
        DepthSize("large", 1024, 24, (4, 11, 17, 23), 256, (256, 512, 1024, 1024)),
    )
}


def get_size(name: str) -> DepthSize:
    """The size called `name`; UserError with the nearest name otherwise."""
    return looked_up("size", name, SIZES)
