"""Random cases in Triton's interpreter; on a card those written out: sizes are compiled for."""

import torch
from hypothesis import Phase, settings

from geodiff_plugin._internal.kernels import interpreting

_ON_A_CARD = torch.cuda.is_available() and not interpreting()


def drawn(most: int) -> settings:
    """At most so many random cases next to the ``example`` ones, which alone run on a card."""
    phases = (Phase.explicit,) if _ON_A_CARD else tuple(Phase)
    return settings(max_examples=most, deadline=None, phases=phases)
