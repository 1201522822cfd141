"""Errors that reach the user as one sentence."""


class UwsfmError(Exception):
    """A step failed; the message is one sentence naming the file, key or frame."""


class InputError(UwsfmError, ValueError):
    """The user's input is wrong: a file, a key, a unit, a sign, an order."""


class ExplainedInputError(InputError):
    """Input that contradicts itself, and the mistakes that would explain it.

    Args:
        message: One sentence.
        codes: Names of the mistakes, see `uwsfm.sfm.correction.CODES`, likeliest first.
    """

    def __init__(self, message: str, codes: tuple[str, ...]) -> None:
        super().__init__(message)
        self.codes = codes


class MissingPackageError(UwsfmError, ImportError):
    """An optional package, or a system library it needs, is not installed."""
