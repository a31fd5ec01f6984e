#!/usr/bin/env bash
# Packs programs that are built already; needs Python, GNU tar and strip. The same programs and checkout give the same bytes.
#
#   packaging/package.sh [PROGRAMS [OUT]]
#
# PROGRAMS is the folder of `sixfold` and `sixfold-experiments` (default: target/release), OUT where the archives go (default:
# out/packages):
#   sixfold-VERSION-TARGET.tar.gz   bin, completions, man pages, share/sixfold with weights and samples, licences
#   sixfold-data-VERSION.tar.gz     sixfold/weights and sixfold/demo, for programs installed by cargo
#   SHA256SUMS                      of these two and of the wheels beside them
set -euo pipefail
if [ $# -gt 2 ] || [[ ${1:-} == -* ]]; then
    sed -n '2,/^set /{/^#/s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}"
    exit 2
fi
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
programs=$(cd "${1:-$root/target/release}" && pwd)
mkdir -p "${2:-$root/out/packages}"
out=$(cd "${2:-$root/out/packages}" && pwd)
cd "$root"

for program in sixfold sixfold-experiments; do
    [ -x "$programs/$program" ] || {
        echo "package.sh: $programs/$program is not there: cargo build --release -p sixfold-cli, then -p sixfold-experiments" >&2
        exit 2
    }
done
version=$("$programs/sixfold" --version | cut -d ' ' -f 2)
target=$(rustc -vV | sed -n 's/^host: //p')
# The time of all files: that of the commit.
epoch=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct 2>/dev/null || echo 0)}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

pack() { # FOLDER: an archive of it, the same whoever packs it and when
    chmod -R u=rwX,go=rX "$scratch/$1"
    tar --sort=name --mtime="@$epoch" --owner=0 --group=0 --numeric-owner --format=gnu -C "$scratch" -cf - "$1" | gzip -9n
}

data() { # FOLDER: weights and samples, each with its licence
    mkdir -p "$1"
    cp -r weights "$1/weights"
    cp -r data/demo "$1/demo"
}

name=sixfold-$version-$target
stage=$scratch/$name
mkdir -p "$stage"/bin "$stage"/share/{bash-completion/completions,zsh/site-functions,fish/vendor_completions.d,man/man1,sixfold}
for program in sixfold sixfold-experiments; do
    strip -o "$stage/bin/$program" "$programs/$program"
done
"$programs/sixfold" completions bash >"$stage/share/bash-completion/completions/sixfold"
"$programs/sixfold" completions zsh >"$stage/share/zsh/site-functions/_sixfold"
"$programs/sixfold" completions fish >"$stage/share/fish/vendor_completions.d/sixfold.fish"
python3 packaging/man.py "$programs/sixfold" "$programs/sixfold-experiments" "$stage/share/man/man1"
gzip -9n "$stage"/share/man/man1/*
data "$stage/share/sixfold"
cp README.md CHANGELOG.md LICENSE-MIT LICENSE-APACHE "$stage"
python3 packaging/licences.py "$target" sixfold-cli sixfold-experiments >"$stage/THIRD-PARTY.txt"
pack "$name" >"$out/$name.tar.gz"

data "$scratch/sixfold"
pack sixfold >"$out/sixfold-data-$version.tar.gz"

cd "$out"
shopt -s nullglob
sha256sum "$name.tar.gz" "sixfold-data-$version.tar.gz" *.whl >SHA256SUMS
for file in "$name.tar.gz" "sixfold-data-$version.tar.gz"; do
    printf '%s %s\n' "$(numfmt --to=si --suffix=B "$(stat -c %s "$file")")" "$out/$file"
done
