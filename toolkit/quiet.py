"""Silence for robosuite's greetings: notices, at every import, about options that this toolkit does not use.

Imports nothing heavy, so that a new process can be silenced before it loads robosuite.
"""

import logging
import os
import threading
from importlib import import_module
from multiprocessing import parent_process
from multiprocessing.process import BaseProcess
from typing import Any


def silence_robosuite() -> None:
    """Let only errors of robosuite's logger through; call before robosuite is imported, in every process."""
    logging.getLogger("robosuite_logs").addFilter(_only_errors)


def _only_errors(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.ERROR


def start_worker() -> None:
    """First call in a worker process: silent, and gone with its parent.

    A worker whose parent was killed would wait, with its memory, for ever.
    """
    silence_robosuite()
    threading.Thread(target=_leave_with, args=(parent_process(),), daemon=True).start()


def _leave_with(parent: BaseProcess | None) -> None:
    if parent is not None:  # the first process has none, and nobody to leave with
        parent.join()
        os._exit(1)


def work_quietly(module: str, function: str, *arguments: Any) -> None:
    """A worker's whole work: the function's module is imported only once the process is silent."""
    start_worker()
    getattr(import_module(module), function)(*arguments)
