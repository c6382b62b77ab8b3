"""The one exception family of the toolkit."""


class ToolkitError(Exception):
    """Bad input, said in one sentence: the culprit, its value, and how to mend it.

    The command line prints the sentence on stderr and exits with status 2.
    """
