"""The part of the build that pyproject.toml cannot say: codecs from the catalogue, C, and the files of uPlot.

`pip install` runs it as part of every build; in an editable install the products land in the source tree.
`python setup.py build_products --inplace` makes them again after a source has changed.

The C is plain C99 behind ctypes: neither Python.h nor any library is needed, and one wheel serves every Python 3.
CC, CFLAGS and LDFLAGS are honoured.
"""

from __future__ import annotations

import logging
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import distribution
from pathlib import Path
from typing import ClassVar

from setuptools import Command, Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build import build
from setuptools.command.sdist import sdist

CATALOGUE = Path("harness/analogrig/_catalogue.py")
ENGINE = Path("emulator/analogrig_emulator/_engine.so")
DEVICE = Path("harness/analogrig/_device.so")
WIDE_DEVICE = Path("harness/analogrig/_device_wide.so")
FIXED_DEVICE = Path("harness/analogrig/_device_fixed.so")
HOST = Path("harness/analogrig/bin/analogrig-device")
WIDE_HOST = Path("harness/analogrig/bin/analogrig-device-wide")
TETHER = Path("harness/analogrig/bin/analogrig-tether")
LIBRARY_CHILD = Path("harness/analogrig/bin/analogrig-library")
STAMP = Path("harness/analogrig/_commit.txt")
UPLOT = {
    Path("harness/analogrig/reporting/uPlot.iife.min.js"): "uplot/static/uPlot.iife.js",
    Path("harness/analogrig/reporting/uPlot.min.css"): "uplot/static/uPlot.min.css",
}
DEVICES = (DEVICE, WIDE_DEVICE, FIXED_DEVICE, HOST, WIDE_HOST)
PRODUCTS = (CATALOGUE, ENGINE, *DEVICES, TETHER, LIBRARY_CHILD, *UPLOT)

GENERATE = Path("estimator_c/catalogue/generate.py")
ENGINE_SOURCES = ("emulator/analogrig_emulator/engine/*.c", "emulator/analogrig_emulator/engine/fast/*.c")
DEVICE_SOURCES = ("estimator_c/core/*.c", "estimator_c/isolation/*.c", "estimator_c/fit/*.c", "estimator_c/device/*.c")
HOST_SOURCES = ("estimator_c/ports/host/*.c", "estimator_c/ports/loop/*.c")
LIBRARY_SOURCES = ("estimator_c/ports/library/*.c",)
TETHER_SOURCES = ("harness/analogrig/devices/tether.c",)
LIBRARY_CHILD_SOURCES = ("harness/analogrig/devices/library_child.c",)
DATA = Path("analogrig")
"""The package of the wheel that receives SHIPPED, at the same paths below it."""
FIXTURES = ("fixtures/*/*.toml",)  # and not the pictures of the README
ESTIMATOR = (
    "estimator_c/*.md",
    *(f"estimator_c/{part}/*.[ch]" for part in ("core", "isolation", "fit", "device")),
    *(f"estimator_c/ports/**/*.{suffix}" for suffix in ("c", "h", "S", "ld")),
    "estimator_c/catalogue/*",
)
"""Sources that a user compiles into an own device."""
SHIPPED = (*FIXTURES, *ESTIMATOR)
GENERATED = tuple(f"analogrig_{part}.{suffix}" for part in ("catalogue", "codec") for suffix in "ch")
"""C that comes from the catalogue. The wheel has it in estimator_c/generated, a checkout in build/generated."""
OTHER_SOURCES = ("emulator/analogrig_emulator/engine/**/*.h", *SHIPPED)

# Without contraction the estimates are the same bits on every machine: these come last, after the user's CFLAGS.
# A computer has room for extended least squares as well.
ROOM = ("-DEST_NC_MAX=2U",)
WIDE_ROOM = (*ROOM, "-DEST_NA_MAX=7U", "-DEST_NB_MAX=8U", "-DEST_THETA_MAX=16U")  # for plants of up to order 7
FIXED_ORDERS = (
    "-DEST_FIXED_NA=2U",
    "-DEST_FIXED_NB=3U",
    "-DEST_FIXED_NK=0U",
    "-DEST_FIXED_NC=0U",
    "-DEST_FIXED_OFFSET=1U",
)
"""Those of the default device. An estimate takes 14 % less time with gcc 12, 25 % less with clang 19."""
CORE = Path("estimator_c/core/est.c")
FLAT = ("-DLIBRARY_FLAT", "-fno-semantic-interposition", "-fno-tree-vectorize")
"""Make CORE a part of library.c, and its step a part of the loop over samples.

Without the second option gcc calls it all the same. Vectors of so few parameters take longer than numbers.
"""
BIT_EXACT = ("-std=c99", "-ffp-contract=off", "-fno-fast-math")
SHARED = ("-shared", "-fPIC")
HOST_ROOM = ("-DDEVICE_LOOP_INPUT_SIZE=18360U",)  # 255 blocks, 0.18 s of real time: as long as the harness may be late
POSIX = ("-D_XOPEN_SOURCE=700",)  # pseudo-terminals, processes; no part of the device but its port may know them
LIBRARY_CHILD_FLAGS = (*POSIX, "-D_DEFAULT_SOURCE", "-Iharness/analogrig/include")  # anonymous memory


class BuildProducts(Command):
    """Make what is not Python, beside the Python that uses it."""

    description = "generate the codecs, compile the C and fetch the files of uPlot"
    user_options: ClassVar[list[tuple[str, str | None, str]]] = [
        ("build-lib=", "b", "directory that receives the products"),
        ("build-temp=", "t", "directory for generated C"),
        ("inplace", "i", "put the products into the source tree"),
    ]
    boolean_options: ClassVar[list[str]] = ["inplace"]

    build_lib: str
    build_temp: str
    inplace: bool
    editable_mode: bool

    def initialize_options(self) -> None:
        """Part of the protocol of setuptools."""
        self.build_lib = self.build_temp = None  # type: ignore[assignment]  # filled in by finalize_options
        self.inplace = self.editable_mode = False

    def finalize_options(self) -> None:
        """Part of the protocol of setuptools."""
        self.set_undefined_options("build", ("build_lib", "build_lib"), ("build_temp", "build_temp"))

    def run(self) -> None:
        """Make every product; each appears whole or not at all."""
        in_tree = self.inplace or self.editable_mode
        if self.editable_mode and self._is_current():
            return

        def placed(product: Path) -> Path:
            return product if in_tree else Path(self.build_lib) / in_wheel(product)

        generated = Path("build" if in_tree else self.build_temp) / "generated"
        for product in PRODUCTS:
            placed(product).parent.mkdir(parents=True, exist_ok=True)
        generate_codecs(generated, placed(CATALOGUE))
        device = (*sources(DEVICE_SOURCES), *sorted(generated.glob("*.c")))
        folders = (*(f"estimator_c/{part}" for part in ("core", "isolation", "fit", "device", "ports/loop")), generated)
        include = tuple(f"-I{path}" for path in folders)
        fixed = (*SHARED, *ROOM, *FIXED_ORDERS, "-DNDEBUG", *FLAT, *include)
        but_core = (file for file in device if file != CORE)
        compiled = [
            partial(compile_c, placed(FIXED_DEVICE), (*sources(LIBRARY_SOURCES), *but_core), fixed),
            partial(compile_c, placed(ENGINE), sources(ENGINE_SOURCES), SHARED),
            partial(compile_c, placed(TETHER), sources(TETHER_SOURCES), POSIX),
            partial(
                compile_c, placed(LIBRARY_CHILD), sources(LIBRARY_CHILD_SOURCES), LIBRARY_CHILD_FLAGS, ("-ldl", "-lm")
            ),
        ]
        linked: list[partial[None]] = []
        for library, host, room in ((DEVICE, HOST, ROOM), (WIDE_DEVICE, WIDE_HOST, WIDE_ROOM)):
            parts = {file: generated.with_name("objects") / library.stem / f"{file.stem}.o" for file in device}
            for_part = ("-c", "-fPIC", *room, *include)
            compiled += [partial(compile_c, part, (file,), for_part) for file, part in parts.items()]
            for_library, for_host = (*SHARED, *room, *include), (*POSIX, *HOST_ROOM, *room, *include)
            linked += [
                partial(compile_c, placed(library), (*sources(LIBRARY_SOURCES), *parts.values()), for_library),
                partial(compile_c, placed(host), (*sources(HOST_SOURCES), *parts.values()), for_host),
            ]
        in_parallel(compiled)
        in_parallel(linked)
        for product, origin in UPLOT.items():
            shutil.copyfile(str(distribution("uplot-python").locate_file(origin)), placed(product))
        if not in_tree:
            for copied, path in self._shipped(generated).items():
                copied.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copied)
            (Path(self.build_lib) / in_wheel(STAMP)).write_text(f"{commit()}\n", encoding="ascii")

    def _is_current(self) -> bool:
        """True if the products in the source tree are newer than all sources: `make` has compiled them just before."""
        newest = max(Path(file).stat().st_mtime for file in (*self.get_source_files(), "setup.py"))
        return all(product.is_file() and product.stat().st_mtime > newest for product in PRODUCTS)

    def _shipped(self, generated: Path) -> dict[Path, Path]:
        """Files of the wheel that are copies, and their originals."""
        package = Path(self.build_lib) / DATA
        codecs = {package / "estimator_c" / "generated" / name: generated / name for name in GENERATED}
        return {**{package / path: path for path in sources(SHIPPED)}, **codecs}

    def get_source_files(self) -> list[str]:
        """Part of the protocol of setuptools: what an sdist must hold."""
        programs = (*HOST_SOURCES, *LIBRARY_SOURCES, *TETHER_SOURCES, *LIBRARY_CHILD_SOURCES)
        return [str(path) for path in sources((*ENGINE_SOURCES, *DEVICE_SOURCES, *programs, *OTHER_SOURCES))]

    def get_outputs(self) -> list[str]:
        """Part of the protocol of setuptools."""
        products = [Path(self.build_lib) / in_wheel(product) for product in PRODUCTS]
        return [str(path) for path in (*products, *self._shipped(Path()))]

    def get_output_mapping(self) -> dict[str, str]:
        """Part of the protocol of setuptools: where an editable install finds each product."""
        return {str(Path(self.build_lib) / in_wheel(product)): str(product) for product in PRODUCTS}


def in_wheel(product: Path) -> Path:
    """Path below site-packages: the folders ``harness`` and ``emulator`` hold packages and are none themselves."""
    return Path(*product.parts[1:])


def commit() -> str:
    """Commit that a wheel will name as its origin: of this checkout, or the one that made this sdist; empty if unknown.

    A checkout itself holds no stamp, which would be wrong after the next commit.
    """
    if not Path(".git").exists():
        return STAMP.read_text(encoding="ascii").strip() if STAMP.is_file() else ""
    described = []
    for words in (("rev-parse", "--short=12", "HEAD"), ("status", "--porcelain", "--untracked-files=no")):
        try:
            done = subprocess.run(["git", *words], capture_output=True, text=True, check=False)
        except OSError:
            return ""
        described.append(done.stdout.strip() if done.returncode == 0 else "")
    head, changes = described
    return f"{head}+dirty" if head and changes else head


def sources(patterns: Iterable[str]) -> tuple[Path, ...]:
    """The files that match, in an order that is the same everywhere."""
    return tuple(sorted(path for pattern in patterns for path in Path().glob(pattern) if path.is_file()))


def generate_codecs(generated: Path, tables: Path) -> None:
    """Generate C into the folder ``generated`` and the Python module ``tables`` from the message catalogue."""
    generated.mkdir(parents=True, exist_ok=True)
    if subprocess.run([sys.executable, GENERATE, generated, tables], check=False).returncode != 0:
        raise SystemExit(f"analogrig: {GENERATE} failed")
    os.utime(tables)  # it may have been left as it was; make must see that it is up to date


def in_parallel(work: Iterable[Callable[[], None]]) -> None:
    """Run as many compilers at a time as there are processors."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done in [pool.submit(each) for each in work]:
            done.result()


def compile_c(product: Path, files: Iterable[Path], flags: Iterable[str], libraries: Iterable[str] = ()) -> None:
    """Compile, and link unless the flags hold -c.

    A program that has the old product open keeps it: the new one is a new file, moved into place.
    """
    part = product.with_name(f".{product.name}.{os.getpid()}")
    options = ["-O2", *words("CFLAGS"), *flags, *BIT_EXACT]
    linking = () if "-c" in options else (*libraries, *words("LDFLAGS"))
    command = [*compiler(), *options, "-o", str(part), *map(str, files), *linking]
    part.parent.mkdir(parents=True, exist_ok=True)
    logging.getLogger(__name__).info(shlex.join(command))
    try:
        if subprocess.run(command, check=False).returncode != 0:
            raise SystemExit(
                f"analogrig: cannot compile {product.name}, see above (stdint.h not found? apt-get install libc6-dev)"
            )
        part.replace(product)
    finally:
        part.unlink(missing_ok=True)


def compiler() -> list[str]:
    """The command of the C compiler: that of CC, or the system's."""
    command = words("CC") or ["cc"]
    if shutil.which(command[0]) is None:
        raise SystemExit(f"analogrig: there is no C compiler {command[0]!r}: apt-get install gcc libc6-dev")
    return command


def words(variable: str) -> list[str]:
    """The words of an environment variable, as a shell would split them."""
    return shlex.split(os.environ.get(variable, ""))


class CleanBuild(build):
    """A build from nothing, so that a file which is gone from the sources is gone from the wheel."""

    sub_commands: ClassVar = [*build.sub_commands, ("build_products", None)]

    def run(self) -> None:
        """Forget the last build, then build."""
        shutil.rmtree(self.build_lib, ignore_errors=True)
        super().run()


class StampedSdist(sdist):
    """A source distribution that names its commit, for the wheels that are built from it."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Part of the protocol of setuptools."""
        super().make_release_tree(base_dir, files)
        (Path(base_dir) / STAMP).write_text(f"{commit()}\n", encoding="ascii")


class PlatformWheel(bdist_wheel):
    """A wheel for one platform and every Python 3: its C does not know Python."""

    def get_tag(self) -> tuple[str, str, str]:
        """Part of the protocol of setuptools."""
        return "py3", "none", super().get_tag()[2]


class PlatformDistribution(Distribution):
    """A distribution that holds machine code, though no extension module."""

    def has_ext_modules(self) -> bool:
        """Part of the protocol of setuptools."""
        return True


setup(
    distclass=PlatformDistribution,
    cmdclass={
        "bdist_wheel": PlatformWheel,
        "build": CleanBuild,
        "build_products": BuildProducts,
        "sdist": StampedSdist,
    },
)
