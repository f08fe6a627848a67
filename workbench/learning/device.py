"""Where a training computes.  "cpu", "cuda", "cuda:1" or "mps" -> a torch device that is there."""

import os

import torch


def devices() -> list[str]:
    """What torch can compute on here."""
    return [
        "cpu",
        *(f"cuda:{index}" for index in range(torch.cuda.device_count())),
        *(["mps"] if torch.backends.mps.is_available() else []),
    ]


def device_named(name: str) -> torch.device:
    """A device by name; `cuda` is the first GPU, or under torchrun this process's own (LOCAL_RANK).

    Raises ValueError for a device that is not there, and for one that several processes would share.
    """
    there, together = devices(), int(os.environ.get("WORLD_SIZE", "1")) > 1
    if together and name not in ("cpu", "cuda"):
        raise ValueError(
            f"several processes cannot share device {name!r}: with torchrun give cuda, each its own GPU, or cpu"
        )
    found = f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if name == "cuda" else name
    if found not in there:
        seen = ", ".join(there) if len(there) > 1 else "cpu only"
        raise ValueError(
            f"there is no device {found if together else name!r} here: torch sees {seen}; "
            "name one of these, or install a torch that sees your GPU (https://pytorch.org/get-started)"
        )
    device = torch.device(found)
    if device.type == "cuda":
        torch.cuda.set_device(device)  # where NCCL waits
    return device
