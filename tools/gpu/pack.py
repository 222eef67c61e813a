"""Pack what a GPU machine without a network lacks: `python tools/gpu/pack.py [FOLDER] [--parts site gl mesa]`.

For Python 3.12 on x86-64 Linux: the packages of vla that an image with PyTorch lacks, without what vla does not use;
the loaders of OpenGL as Debian packages; Mesa's software renderer of this machine, to compare with and to fall back on.
Needs pip, and for the last two parts apt-get, binutils and gcc.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parents[2]
LARGEST = 45 * 2**20  # [bytes] of the folder
# Of what vla depends on, the machine has these, and the two that only videos and recordings need, 36 and 171 MB, stay.
# It also has lxml, of dm_control, and for step v transformers and peft.
THERE = {
    *("filelock", "jinja2", "lightning", "matplotlib", "numpy", "pillow", "psutil", "pyarrow", "pyyaml", "rich"),
    *("safetensors", "scipy", "tensorboard", "timm", "tokenizers", "torch", "torchmetrics", "torchvision"),
}
LEFT_OUT = {"av", "rerun-sdk"}
PACKAGES = (
    *("absl-py", "annotated-types", "antlr4-python3-runtime", "cloudpickle", "dm-env", "dm-tree", "dm_control"),
    "Farama-Notifications",
    *("fast-simplification", "glcontext", "glfw", "gymnasium", "gymnasium-robotics", "hydra-core", "loky", "moderngl"),
    *("mujoco", "omegaconf", "pydantic", "pydantic_core", "PyOpenGL", "typing-inspection"),
)
GLIBC = (39, 35, 34, 31, 28, 27, 24, 17, 12, 5)  # minor versions that wheels name; pip matches them exactly
# Of these packages only the files that match stay; of gymnasium-robotics the meshes that the tabletop's arm is made of.
KEPT = {
    "dm_control": r"dm_control/(__init__\.py|_render|mjcf|mujoco|rl|utils|third_party/kinova)(/|$)",
    "gymnasium_robotics": r".*/assets/(LICENSE|kitchen_franka/franka_assets/(LICENSE|meshes/collision/))",
}
DROPPED = re.compile(
    r"mujoco/(experimental|include|introspect|mjx|plugin|sample|usd|testdata|sysid|viewer|codegen)/"
    r"|mujoco/(_render_filament|_simulate|minimize|rollout_test)|OpenGL/(raw/)?(GLX|WGL|GLES\w*|GLU\w*|GLE|Tk|DLLS)/"
    r"|OpenGL/(raw/OSMESA|GL/(?!ARB/__init__|__init__)\w+)/|hydra/(test_utils|grammar/gen/.*\.interp)"
    r"|gymnasium/(envs/(box2d|classic_control|mujoco|toy_text)|wrappers/vector)/.*\.(png|xml|stl|ttf)$"
    r"|.*(_test\.py|\.pyi)$|.*/(tests?|test_assets|testing/assets)/|.*dist-info/(RECORD|top_level\.txt|sboms/)"
)
LOADERS = ("libegl1", "libglvnd0", "libopengl0", "libgl1", "libglx0", "libgles2", "libvulkan1")
LIBRARIES = Path("/usr/lib/x86_64-linux-gnu")
ENTRIES = ("libEGL.so.1", "libGL.so.1", "libGLX.so.0", "libGLdispatch.so.0", "libOpenGL.so.0", "libEGL_mesa.so.0")
EVERYWHERE = re.compile(r"(libc|libm|libdl|libpthread|librt|libstdc\+\+|libgcc_s|ld-linux-x86-64)\.so")
# libLLVM calls these for manifests of Windows and for its static analyser only: empty ones will do, 60 MB less.
UNUSED = {"libxml2.so.2": "LIBXML2", "libz3.so.4": "Z3_"}


def run(*command: str | Path, folder: Path | None = None) -> str:
    """Return the output of a command, whose failure ends this program."""
    return subprocess.run(command, cwd=folder, check=True, stdout=subprocess.PIPE, text=True).stdout


def pack_site(target: Path, work: Path) -> None:
    """Write site.tar.xz: the packages, in the versions of constraints.txt."""
    pins = pinned(PACKAGES)
    source = [pin for pin in pins if pin.startswith("antlr4")]  # has no wheel
    binary = [pin for pin in pins if pin not in source]
    pip, wheels = [sys.executable, "-m", "pip"], work / "wheels"
    tags = [f"manylinux_2_{minor}_x86_64" for minor in GLIBC]
    tags += [f"manylinux{name}_x86_64" for name in ("2014", "2010", "1")]
    platforms = [part for tag in tags for part in ("--platform", tag)]
    abis = [part for abi in ("cp312", "abi3", "none") for part in ("--abi", abi)]
    python = ["--python-version", "3.12", "--implementation", "cp", "--only-binary=:all:", *abis]
    run(*pip, "download", "-q", "--no-deps", *python, *platforms, "-d", wheels, *binary)
    run(*pip, "wheel", "-q", "--no-deps", "-w", wheels, *source)
    for wheel in sorted(wheels.glob("*.whl")):
        unpack(wheel, work / "site")
    # vla looks for the folder of this package, and does not import it.
    (work / "site/gymnasium_robotics/__init__.py").write_text('"""Only the meshes of the arm."""\n')
    compress(work / "site", target)


def pinned(names: Iterable[str]) -> list[str]:
    """Return the lines of constraints.txt for packages."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    versions = {normalised(line.partition("==")[0]): line for line in lines if "==" in line}
    return [versions[normalised(name)] for name in names]


def normalised(name: str) -> str:
    """Return the name of a package as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def unpack(wheel: Path, site: Path) -> None:
    """Unpack the files of a wheel that are used."""
    pattern = re.compile(KEPT.get(re.split(r"-\d", wheel.name)[0].lower(), ""))
    with zipfile.ZipFile(wheel) as archive:
        for info in archive.infolist():
            name = re.sub(r"^[^/]+\.data/(purelib|platlib)/", "", info.filename)
            unused = DROPPED.match(name) or (".dist-info/" not in name and not pattern.match(name))
            if not info.is_dir() and ".data/" not in name and not unused:
                (site / name).parent.mkdir(parents=True, exist_ok=True)
                (site / name).write_bytes(archive.read(info))


def pack_gl(target: Path, work: Path) -> None:
    """Download the Debian packages of the loaders of OpenGL into gl/; the driver is there."""
    lists, packages = work / "lists", target / "gl"
    (lists / "partial").mkdir(parents=True)
    shutil.rmtree(packages, ignore_errors=True)
    packages.mkdir(parents=True)
    apt = ["apt-get", "-qq", "-oAPT::Architecture=amd64", "-oAPT::Architectures=amd64", f"-oDir::State::Lists={lists}"]
    run(*apt, "update")
    run(*apt, "-oAPT::Sandbox::User=root", "download", *LOADERS, folder=packages)


def pack_mesa(target: Path, work: Path) -> None:
    """Write mesa.tar.xz: the software renderer of this machine, with all that it links to."""
    mesa, driver = work / "mesa", LIBRARIES / "dri/swrast_dri.so"
    (mesa / "lib").mkdir(parents=True)
    (mesa / "dri").mkdir()
    shutil.copy(driver, mesa / "dri")
    for name in ENTRIES:
        shutil.copy(LIBRARIES / name, mesa / "lib")
    libraries = {line for path in (driver, *(LIBRARIES / name for name in ENTRIES)) for line in links(path)}
    for path in libraries:
        if not EVERYWHERE.match(path.name) and not path.name.startswith("libicu"):
            shutil.copy(path, mesa / "lib")
    llvm = next((mesa / "lib").glob("libLLVM*"))
    for name, mark in UNUSED.items():
        if (mesa / "lib" / name).exists():
            write_stub(llvm, mark, mesa / "lib" / name, work)
    run("strip", "--strip-unneeded", *(mesa / "lib").glob("*.so*"), *(mesa / "dri").glob("*.so"))
    icd = {"file_format_version": "1.0.0", "ICD": {"library_path": "libEGL_mesa.so.0"}}
    (mesa / "vendor.json").write_text(json.dumps(icd))
    compress(mesa, target)


def links(library: Path) -> Iterator[Path]:
    """Yield the libraries that a library links to."""
    for line in run("ldd", library).splitlines():
        if match := re.search(r"=> (/\S+)", line):
            yield Path(match[1])


def write_stub(user: Path, mark: str, target: Path, work: Path) -> None:
    """Replace a library by an empty one with the symbols, and their versions, that `user` has of it."""
    imports = [line.split()[-1] for line in run("nm", "-D", "--undefined-only", user).splitlines()]
    symbols = sorted({tuple(symbol.replace("@@", "@").partition("@")[::2]) for symbol in imports if mark in symbol})
    source, script = work / "stub.c", work / "stub.map"
    source.write_text("".join(f"void *{name};\n" for name, _ in symbols))
    versions = {version: [name for name, other in symbols if other == version] for _, version in symbols if version}
    script.write_text("".join(f"{version} {{ {'; '.join(names)}; }};\n" for version, names in versions.items()))
    flags = [f"-Wl,--version-script={script}"] if versions else []
    target.unlink()
    run("gcc", "-shared", "-fPIC", f"-Wl,-soname,{target.name}", *flags, source, "-o", target)


def compress(folder: Path, target: Path) -> None:
    """Write a folder as a compressed archive of its name into another folder."""
    archive = shutil.make_archive(str(folder), "xztar", folder.parent, folder.name)
    shutil.move(archive, target / Path(archive).name)


def main() -> None:
    """Pack the parts that the command line names, and say how large everything is."""
    parts = {"site": pack_site, "gl": pack_gl, "mesa": pack_mesa}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / ".gpu", help="what travels; default: .gpu")
    parser.add_argument("--parts", nargs="*", choices=parts, default=[*parts], help="others stay as they are")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    for name in options.parts:
        with TemporaryDirectory() as work:
            parts[name](options.folder.resolve(), Path(work))
    sizes = {path: path.stat().st_size for path in sorted(options.folder.rglob("*")) if path.is_file()}
    for path, size in sizes.items():
        print(f"{size / 2**20:6.1f} MiB {path}")
    print(f"{sum(sizes.values()) / 2**20:6.1f} MiB in all")
    if sum(sizes.values()) > LARGEST:
        sys.exit(f"error: more than {LARGEST / 2**20:.0f} MiB: leave mesa out, --parts site gl in a new folder")


if __name__ == "__main__":
    main()
