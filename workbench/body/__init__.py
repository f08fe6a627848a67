"""The parametric body: skeleton, skinning functions, model (Eq. 2-3)."""

from workbench.body.model import Body
from workbench.body.skeleton import Skeleton

__all__ = ["Body", "Skeleton"]
