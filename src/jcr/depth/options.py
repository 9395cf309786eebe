"""Options of dense depth, in a module of their own so that the command line's help imports little."""

from dataclasses import dataclass
from typing import Annotated

import tyro


@dataclass(frozen=True)
class DepthOptions:
    """Options of the dense depth that the map needs."""

    priors: Annotated[
        bool,
        tyro.conf.arg(
            help="Leave plain surfaces without depth. By default planes fill them where their colour and the matched "
            "depth around them support it. The map uses these planes as surfaces, not as evidence of free space.",
            help_behavior_hint="(default: planes fill them)",
        ),
    ] = True
    """Fill plain surfaces with planes. Networks predict them anyway."""
    pointmap_size_px: tyro.conf.Suppress[int] = 384
    """Long side of the pointmaps: at full and half resolution a multiple of the 16 pixels that are matched at once."""
    neighbours: tyro.conf.Suppress[int] = 10
    """Other images that the depth of each is checked against; matched with the best of them."""
