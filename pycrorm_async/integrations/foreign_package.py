"""A `ForeignPackage` is the library whose executive an integration records, with the versions it supports."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib import metadata

from pycrorm_async.errors import CallerError, MissingExtra


@dataclass(frozen=True)
class ForeignPackage:
    """A library that an extra of this package installs.

    >>> PY_TREES = ForeignPackage("py_trees", extra="py_trees", versions=["2.*"])
    >>> with PY_TREES.importing():
    ...     from py_trees.trees import BehaviourTree

    Attributes:
        name: the name in messages.
        versions: the versions that the integration supports, as patterns of `fnmatch`; empty for any.
    """

    name: str
    extra: str
    versions: Sequence[str] = ()

    @contextmanager
    def importing(self) -> Iterator[None]:
        """Import the library in this block. Raises `MissingExtra` if that fails."""
        try:
            yield
        except ImportError as failure:
            raise MissingExtra(f"{self.name} cannot be imported ({failure}): {self._command}") from None

    def installed_version(self, distribution: str) -> str:
        """Return the version of a distribution, without importing it. Raises `MissingExtra`."""
        try:
            return metadata.version(distribution)
        except metadata.PackageNotFoundError:
            wanted = " ".join(filter(None, (distribution, self._known)))
            raise MissingExtra(f"{self.name} ({wanted}) is not installed: {self._command}") from None

    def check_version(self, version: str) -> None:
        """Raise `CallerError` for a version that the integration does not support."""
        if self.versions and not any(fnmatchcase(version, each) for each in self.versions):
            raise CallerError(f"{self.name} {version} is unknown, only {self._known} can be recorded: {self._command}")

    @property
    def _known(self) -> str:
        return " or ".join(self.versions)

    @property
    def _command(self) -> str:
        return f"pip install 'pycrorm-async[{self.extra}]'"
