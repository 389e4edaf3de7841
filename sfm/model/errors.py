"""The exceptions of Kolinear.

    KolinearError               any error that the user can correct; the command line prints one line
    |-- SurveyFileError         the survey file or a table it names cannot be used
    |-- PhotographError         a photograph cannot be read or does not fit its camera
    |-- GeometryError           the points or photographs do not determine the requested result
    |-- UnknownNameError        no point, photograph or camera has that name
    |-- InstallationError       files of another project lie among Kolinear's
    |-- OutputError             a result cannot be written
    |   `-- FolderInUseError    another run is writing there
    `-- BackendError            an external program or library has the wrong version, fails or refuses
        `-- MissingLibraryError a library is not installed

Rank, convergence and rejected observations are results, not exceptions.
"""

INSTALL_DASK = "pip install 'dask[distributed]' cryptography, the extra kolinear[cluster]"


class KolinearError(Exception):
    """Base class of all errors; the message is one line that states what was found and what was needed."""


class SurveyFileError(KolinearError):
    """The survey file, or a table that it names, cannot be used."""


class PhotographError(KolinearError):
    """A photograph cannot be read or does not fit the camera it is listed under."""


class GeometryError(KolinearError):
    """The given points or photographs do not determine the requested result."""


class DivergedError(GeometryError):
    """Unknowns have become so large in an iteration that their squares overflow."""


class UnknownNameError(KolinearError):
    """No point, photograph or camera has that name."""


class InstallationError(KolinearError, ImportError):
    """Files of another project lie among those of Kolinear."""


class OutputError(KolinearError):
    """A result cannot be written to the requested folder or file."""


class FolderInUseError(OutputError):
    """Another run is writing into the folder."""


class BackendError(KolinearError):
    """An external program or library is missing, has the wrong version, fails or refuses the problem."""


class MissingLibraryError(BackendError):
    """An optional library is not installed; the message says how to install it."""


def missing_library(what: str, libraries: tuple[str, ...], extra: str) -> MissingLibraryError:
    """Return the error that something needs libraries of an extra of this package."""
    it = "it" if len(libraries) == 1 else "them"
    names = " and ".join(libraries)
    return MissingLibraryError(f"{what} needs {names}; install {it} with: pip install 'kolinear[{extra}]'")


def one_line(error: BaseException) -> str:
    """Return the message of an error on one line, or the name of its class if it has no message."""
    return " ".join(str(error).split()) or type(error).__name__
