"""Functions for child processes with limits: each breaks in its own way."""

from __future__ import annotations

import os
import signal
import time


def echo(argument: str) -> bytes:
    print("a library says something")
    return argument.encode()


def nothing(_: str) -> bytes:
    return b""


def crash(_: str) -> bytes:
    os.kill(os.getpid(), signal.SIGSEGV)
    return b""


def wait(_: str) -> bytes:
    time.sleep(600)
    return b""


def compute(_: str) -> bytes:
    while True:
        pass


def fail(_: str) -> bytes:
    raise ValueError("too much")


def allocate(argument: str) -> bytes:
    return bytes(len(bytearray(int(argument))) > 0)


def address_space_limit(_: str) -> bytes:
    import resource

    return str(resource.getrlimit(resource.RLIMIT_AS)[0]).encode()
