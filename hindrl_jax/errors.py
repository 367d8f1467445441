"""The one exception that is meant for the person at the keyboard."""


class UserError(ValueError):
    """Something that the user can put right: a file, an option, a name.

    The message is one line that says what was wrong and what to do about it. The command line prints it without a traceback and exits with
    status 2; every other exception is a bug of ours and keeps its traceback.
    """
