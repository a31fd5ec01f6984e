#!/usr/bin/env bash
# Makes the packages of all crates that are meant for a registry, checks them and lists their sizes.
#
#   packaging/crates.sh            nothing compiled: seconds
#   packaging/crates.sh --build    builds the program from the unpacked packages too, and runs the demo with it. Compiles everything;
#                                  where CARGO_TARGET_DIR names a copy of target, our own crates alone
set -euo pipefail
case ${1:-} in
'' | --build) ;;
*) sed -n '2,/^set /{/^#/s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}"; exit 2 ;;
esac
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

# --allow-dirty: a change is checked before it is committed. Without network first: the index is at hand where the program was built.
package() {
    CARGO_TARGET_DIR=$scratch/target cargo package --workspace --exclude sixfold-fuzz --exclude sixfold-python \
        --no-verify --locked --allow-dirty "$@" >"$scratch/log" 2>&1
}
if ! package --offline && ! package; then
    cat "$scratch/log"
    exit 1
fi
# There is no public address of the project yet that the packages could name.
if grep '^warning' "$scratch/log" | grep -v '^warning: manifest has no documentation, homepage or repository$'; then
    echo "crates.sh: cargo package warns" >&2
    exit 1
fi
python3 - "$scratch/target/package" <<'PY'
import pathlib
import re
import sys
import tarfile

LARGEST = 10_000_000  # bytes that the registry takes
folder, wrong, rows = pathlib.Path(sys.argv[1]), [], []
for path in sorted(folder.glob("*.crate")):
    name = path.name.removesuffix(".crate")
    with tarfile.open(path) as package:
        members = {member.name.removeprefix(name + "/"): member for member in package.getmembers()}
        text = lambda file: package.extractfile(members[file]).read().decode()  # noqa: E731
        for file in ("README.md", "LICENSE-MIT", "LICENSE-APACHE"):
            if file not in members or not members[file].isfile() or members[file].size < 100:
                wrong.append(f"{name}: no {file}")
        for field in ("description", "license", "readme", "keywords", "categories", "rust-version"):
            if not re.search(rf"(?m)^{field} = ", text("Cargo.toml")):
                wrong.append(f"{name}: Cargo.toml has no {field}")
        # What is compiled in has to be in the package, and weights bring their card.
        for file in (file for file in members if file.startswith("src/") and file.endswith(".rs")):
            for named in re.findall(r'include_(?:bytes|str)!\("([^"]+)"\)', text(file)):
                parts = []
                for part in (*file.split("/")[:-1], *named.split("/")):
                    parts = parts[:-1] if part == ".." else [*parts, part]
                if "/".join(parts) not in members:
                    wrong.append(f"{name}: {file} includes {named}, which the package lacks")
        for file in members:
            # Networks of tests are no weights to use: one README tells where all of a folder come from.
            folder = file.rpartition("/")[0]
            card = f"{folder}/README.md" if file.startswith("tests/") else file.removesuffix(".safetensors") + ".md"
            if file.endswith(".safetensors") and card not in members:
                wrong.append(f"{name}: {file} has no card ({card})")
    size = path.stat().st_size
    rows.append((size, name))
    if size > LARGEST:
        wrong.append(f"{name}: {size} bytes, the registry takes {LARGEST}")
for size, name in sorted(rows, reverse=True):
    print(f"{size / 1e6:8.3f} MB  {name}")
print(f"{len(rows)} packages, {sum(size for size, _ in rows) / 1e6:.1f} MB, the largest allowed is {LARGEST / 1e6:.0f} MB")
sys.exit("\n".join(wrong) or (None if rows else "no packages"))
PY
[ "${1:-}" = --build ] || exit 0

# A folder with the unpacked packages and nothing else; each takes the others from there, with the repository's profile and lock file.
made=$scratch/made
mkdir "$made"
for package in "$scratch"/target/package/*.crate; do
    tar -xzf "$package" -C "$made"
done
{
    printf '[workspace]\nresolver = "3"\nmembers = ["*-*.*.*"]\n\n[patch.crates-io]\n'
    for folder in "$made"/*/; do
        folder=$(basename "$folder")
        printf '%s = { path = "%s" }\n' "${folder%-*}" "$folder"
    done
    sed -n '/^\[profile/,$p' Cargo.toml
} >"$made/Cargo.toml"
cp Cargo.lock "$made/Cargo.lock"
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$scratch/build}
version=$(sed -n '/^\[workspace.package\]/,/^$/s/^version = "\(.*\)"/\1/p' Cargo.toml)
(cd "$made" && cargo install --offline --path "sixfold-cli-$version" --root "$scratch/installed" --no-track)
rm -rf "$made"
mkdir "$scratch/here" "$scratch/home"
# The packages have no samples: a copy of the repository's folders stands for the archive of data.
mkdir -p "$scratch/home/.local/share/sixfold"
cp -r data/demo weights "$scratch/home/.local/share/sixfold"
(cd "$scratch/here" && env -i HOME="$scratch/home" PATH=/usr/bin:/bin "$scratch/installed/bin/sixfold" demo --out out)
