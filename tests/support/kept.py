"""Files that tests keep for later sessions, in this user's cache folder, so that every checkout finds them."""

import shutil
import tarfile
import tempfile
from contextlib import contextmanager
from pathlib import Path

import platformdirs


def kept_folder(name, base=None):
    """Return a folder that stays from session to session and serves all checkouts; None where none can be written."""
    folder = Path(base or platformdirs.user_cache_dir("loopwright-tests", appauthor=False)) / name
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return None


@contextmanager
def kept_tree(archive, folder):
    """Fill a folder from an archive, if it is there, and write the archive again afterwards.

    The archive is replaced as a whole: two sessions at once never see, or write, a part of it.
    """
    folder.mkdir(parents=True)
    if archive is not None and archive.is_file():
        with tarfile.open(archive) as kept:
            kept.extraction_filter = getattr(tarfile, "data_filter", lambda member, path: member)  # since 3.11.4
            kept.extractall(folder)
    yield folder
    if archive is not None:
        with tempfile.TemporaryDirectory(dir=archive.parent) as place:
            made = shutil.make_archive(str(Path(place) / "made"), "tar", folder)
            Path(made).replace(archive)
