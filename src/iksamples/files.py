"""Files that appear whole or not at all, and that are known again when they are read.

Beside a file of results, and a folder of figures, lies its SHA-256, ``.<name>.sha256``. A disk or a
hand may change it later; numbers read from such a file would be wrong without a sign of it.
"""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from iksamples.errors import IksamplesError, UnwritableError, in_a_line


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Gives a temporary name beside a file, and the file's own name once all is written.

    Raises:
        UnwritableError: It cannot be written; the error names it.
    """
    path = Path(path)
    unfinished = path.with_name(f".unfinished-{path.name}")
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir():  # which would be found at the end, where others are written already
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            yield unfinished
            # Some writers leave a file that only its owner may read.
            unfinished.chmod(0o666 & ~_umask())
            unfinished.replace(path)
    finally:
        with suppress(OSError):  # a folder that cannot be written to: none was begun there
            unfinished.unlink()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Says of what the system refuses which output it is that cannot be written.

    Args:
        path: The file or folder that is written. What is read in between has errors of its own.

    Raises:
        UnwritableError: It cannot be written.
    """
    try:
        yield
    except Exception as error:
        number, named = getattr(error, "errno", None), getattr(error, "filename", None)
        # Some writers do not name the file.
        if number is None or (named and not _belongs(Path(named), path)):
            raise
        raise UnwritableError(number, os.strerror(number), str(path)) from error


def _belongs(named: Path, path: Path) -> bool:
    """Whether a file is one that is written for an output, or a folder on the way to it."""
    beside = named.parent == path.parent and named.name.startswith(".") and path.name in named.name
    return beside or named == path or named in path.parents or path in named.parents


@contextmanager
def kept_file(path: str | Path) -> Iterator[Path]:
    """As ``whole_file``, and keeps the file's digest, which ``checked`` and ``is_intact`` ask."""
    path = Path(path)
    with whole_file(path) as unfinished:
        yield unfinished
        write_digest(unfinished, path)


def write_digest(written: Path, path: Path) -> None:
    """Keeps the digest of a file, or of a folder, that gets its own name, ``path``, next.

    The digest comes first: a kill in between leaves a file that counts as damaged.
    """
    with whole_file(digest_file(path)) as digest:
        digest.write_text(f"{_sha256(written)}\n", encoding="ascii")


def checked(path: str | Path) -> Path:
    """The path of a file that is to be read, if it is as it was written.

    One without a digest, such as one that was brought along, is taken as it is.

    Raises:
        IksamplesError: It was changed or damaged. It is then out of the way, so that the next run
            makes it again.
    """
    path = Path(path)
    if (aside := put_aside(path)) is None:
        return path
    raise IksamplesError(
        f"{path}: not as it was written (SHA-256), so nothing is read from it; it is now called "
        f"{aside.name}. Run the study again, which makes what is lost."
    )


def put_aside(path: Path) -> Path | None:
    """Gives what is not as it was written another name, and says which; else nothing.

    Args:
        path: A file or a folder of files.
    """
    if not is_damaged(path):
        return None
    aside = path.with_name(f"{path.name}.damaged")
    with suppress(OSError):  # a folder that cannot be written to
        if aside.is_dir():  # of an earlier time
            shutil.rmtree(aside)
        path.replace(aside)
        digest_file(path).unlink()
    return aside


def read_bytes(path: str | Path, most: int, what: str) -> bytes:
    """The content of a file that somebody wrote.

    Args:
        path: The file.
        most: Bytes of the largest that is read.
        what: What it holds, for the message: ``the arm``.

    Raises:
        IksamplesError: It cannot be read, or is larger.
    """
    try:
        require_plain(path)
        with Path(path).open("rb") as file:
            content = file.read(most + 1)
    except (OSError, ValueError) as error:
        raise IksamplesError(f"{path}: cannot read {what} ({in_a_line(error)}).") from None
    if len(content) > most:
        size = f"{most // 10**6} MB" if most >= 10**6 else f"{most // 1000} kB"
        raise IksamplesError(f"{path}: over {size} is no {what.removeprefix('the ')}.")
    return content


def require_plain(path: str | Path) -> None:
    """Stops before a pipe, which would be waited for, and a device, which may have no end.

    Raises:
        OSError: It is such a one, or a folder.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise OSError(
            errno.EINVAL, f"{'a folder' if path.is_dir() else 'a pipe or device'}, no file"
        )


def stored_object(path: Path, kinds: Mapping[str, type]) -> dict[str, Any]:
    """What a JSON file of results says.

    Args:
        path: The file.
        kinds: What has to be in it, and of which type.

    Raises:
        IksamplesError: It is missing, damaged, or says something else.
    """
    try:
        found = json.loads(checked(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise IksamplesError(
            f"{path}: cannot be read ({in_a_line(error)}). Run the study again."
        ) from None
    if not isinstance(found, dict) or not all(
        isinstance(found.get(name), kind) for name, kind in kinds.items()
    ):
        raise IksamplesError(f"{path}: not as it was written. Run the study again.")
    return found


def is_damaged(path: Path) -> bool:
    """Whether a file or a folder of files has a digest and is not as it was written."""
    return path.exists() and digest_file(path).exists() and not is_intact(path)


def is_intact(path: Path) -> bool:
    """Whether a file or a folder is there, has a digest, and is as it was written."""
    try:
        return digest_file(path).read_text(encoding="ascii").strip() == _sha256(path)
    except (OSError, UnicodeDecodeError):
        return False


def digest_file(path: Path) -> Path:
    """Where the digest of a file or a folder lies."""
    return path.with_name(f".{path.name}.sha256")


def _sha256(path: Path) -> str:
    if path.is_dir():
        files = sorted(path.glob("[!.]*"))  # Snakemake leaves a hidden one in it
        listed = "".join(f"{_sha256(file)}  {file.name}\n" for file in files)
        return hashlib.sha256(listed.encode()).hexdigest()
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
