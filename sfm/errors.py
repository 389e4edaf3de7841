"""The exceptions of Kolinear.

    KolinearError               anything that a person can put right; the command line prints one line
    |-- SurveyFileError         the survey file or a table it names cannot be used
    |-- PhotographError         a photograph cannot be read or does not fit its camera
    |-- GeometryError           the points or photographs do not determine what is asked for
    |-- UnknownNameError        a point, photograph or camera of that name is not there
    |-- InstallationError       files of another project lie among Kolinear's
    |-- OutputError             a result cannot be written
    |   `-- FolderInUseError    another run is writing there
    `-- BackendError            an external program or library is of another version, fails or refuses
        `-- MissingLibraryError it is not installed

Rank, convergence and rejected observations are results, not exceptions.
"""


class KolinearError(Exception):
    """Base of all errors whose message is one line that says what was found and what was needed."""


class SurveyFileError(KolinearError):
    """The survey file, or a table that it names, cannot be used as it stands."""


class PhotographError(KolinearError):
    """A photograph cannot be read or does not fit the camera it is listed under."""


class GeometryError(KolinearError):
    """The given points or photographs do not determine what is asked for."""


class UnknownNameError(KolinearError):
    """There is no point, photograph or camera of that name."""


class InstallationError(KolinearError, ImportError):
    """Files of another project lie among those of Kolinear."""


class OutputError(KolinearError):
    """A result cannot be written where it was asked for."""


class FolderInUseError(OutputError):
    """Another run is writing into the folder."""


class BackendError(KolinearError):
    """An external library is missing, of the wrong version, or refuses the problem."""


class MissingLibraryError(BackendError):
    """A library is not installed that only some commands need; the message says how to install it."""


def one_line(error: BaseException) -> str:
    """Return the message of an error on one line, the name of its kind where it has none."""
    return " ".join(str(error).split()) or type(error).__name__
