"""A cache of compiled templates in the same folders as the compiled kernels (:mod:`egvs.core.cache_folder`).

Jinja checks that a cached template is of its version, of this version of Python, and of the same text, but trusts the
rest of the file. Here, each file starts with the hash of its content, and a damaged one is compiled again. Templates
also depend on the options of their environment: the name of the folder has a hash of the module that sets them.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import jinja2
from jinja2 import BytecodeCache
from jinja2.bccache import Bucket

from egvs.core.cache_folder import find_cache_folder, read_checked, write_checked


class TemplateCache(BytecodeCache):
    """Compiled templates; a file for each.

    Parameters
    ----------
    folder
        Where the files are.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load_bytecode(self, bucket: Bucket) -> None:
        """Fill a bucket with its compiled template, if there is an intact one."""
        content = read_checked(self._file(bucket))
        if content is not None:
            bucket.bytecode_from_string(content)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Write the compiled template of a bucket."""
        write_checked(self._file(bucket), bucket.bytecode_to_string())

    def _file(self, bucket: Bucket) -> Path:
        return self._folder / f"{bucket.key}.template"


def open_template_cache(module: Path) -> TemplateCache | None:
    """Return the cache of the templates of a module, which sets their options; None where no folder can be written.

    Parameters
    ----------
    module
        File of the module.
    """
    digest = hashlib.sha256(f"jinja {jinja2.__version__} python {sys.version}".encode() + module.read_bytes())
    folder = find_cache_folder(module.parent, "jinja", digest.hexdigest())
    return None if folder is None else TemplateCache(folder)
