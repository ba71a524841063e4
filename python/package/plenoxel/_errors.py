"""The exceptions of the package. Their messages are those of the library."""


class Error(Exception):
    """Any error of the package."""


class SettingsError(Error, ValueError):
    """A setting or an argument cannot be used as it is given."""


class InputError(Error, ValueError):
    """A file or a folder has invalid content."""


class NumericError(Error, ArithmeticError):
    """A computation produced numbers that are not finite."""


class FileError(Error, OSError):
    """The operating system failed to read or write."""


class ArrayError(Error, ValueError):
    """An array or a tensor has the wrong shape, or numbers that cannot be used."""


class DtypeError(Error, TypeError):
    """A value has the wrong type, or an array the wrong type of numbers."""


class StateError(Error, RuntimeError):
    """Something is not possible any more, or not yet."""


class GradcheckError(Error, AssertionError):
    """A derivative differs from finite differences."""


class Interrupted(KeyboardInterrupt):
    """Training was interrupted by Ctrl-C and is saved. ``plenoxel.resume(error.folder)`` continues."""

    def __init__(self, folder, steps, total):
        super().__init__(f"interrupted after step {steps} of {total}; the training is saved; resume with plenoxel.resume({str(folder)!r})")
        self.folder = folder
        self.steps = steps
        self.total = total
