"""Torchvision beside a torch without CUDA, which LeRobot imports and does not need for numbers."""

from __future__ import annotations

from importlib import import_module


def import_torchvision() -> None:
    """Import torchvision whose compiled operators, built for CUDA, do not load."""
    import torch

    register = torch.library.register_fake
    torch.library.register_fake = lambda *args, **kwargs: lambda function: function
    try:
        import_module("torchvision")
    finally:
        torch.library.register_fake = register
