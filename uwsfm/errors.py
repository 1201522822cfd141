"""Errors that reach the user as one sentence."""


class UwsfmError(Exception):
    """A step failed; the message is one sentence naming the file, key or frame."""


class InputError(UwsfmError, ValueError):
    """The user's input is wrong: a file, a key, a unit, a sign, an order."""


class MissingPackageError(UwsfmError, ImportError):
    """An optional package, or a system library it needs, is not installed."""
