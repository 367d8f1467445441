"""The one exception that is meant for the person at the keyboard, and how others are quoted in it."""


class UserError(ValueError):
    """Something that the user can put right: a file, an option, a name.

    The message is one line that says what was wrong and what to do about it. The command line prints it without a traceback and exits with
    status 2; every other exception is a bug of ours and keeps its traceback.
    """


def one_line(error: BaseException) -> str:
    """The message of an exception, or its name if it has none, as part of one line."""
    return " ".join(str(error).split()) or type(error).__name__
