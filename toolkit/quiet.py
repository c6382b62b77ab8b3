"""Silence for robosuite's greetings: notices, at every import, about options that this toolkit does not use."""

import logging


def silence_robosuite() -> None:
    """Let only errors of robosuite's logger through; call before robosuite is imported, in every process."""
    logging.getLogger("robosuite_logs").addFilter(_only_errors)


def _only_errors(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.ERROR
