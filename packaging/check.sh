#!/usr/bin/env bash
# Unpacks what packaging/package.sh wrote and uses it as a stranger would: in an empty folder, with an empty home, outside the
# repository. The samples and weights that are used have to be those of the archive.
#
#   packaging/check.sh OUT
set -euo pipefail
if [ $# -ne 1 ] || [ ! -f "$1/SHA256SUMS" ]; then
    sed -n '2,/^set /{/^#/s/^# \{0,1\}//p}' "${BASH_SOURCE[0]}"
    exit 2
fi
out=$(cd "$1" && pwd)
scratch=$(cd "$(mktemp -d)" && pwd -P)
trap 'rm -rf "$scratch"' EXIT
mkdir "$scratch/home" "$scratch/here" "$scratch/alone"
fail() { echo "check.sh: $*" >&2; exit 1; }

(cd "$out" && sha256sum --check --quiet SHA256SUMS)
programs=("$out"/sixfold-[0-9]*.tar.gz)
[ ${#programs[@]} -eq 1 ] || fail "one archive of programs expected in $out, found ${#programs[@]}"
tar -xzf "${programs[0]}" -C "$scratch"
prefix=("$scratch"/sixfold-*)
clean() { (cd "$scratch/here" && env -i HOME="$scratch/home" PATH=/usr/bin:/bin "$@"); }

# The whole demo: poses from depth and, with the weights, from colour.
clean "$prefix/bin/sixfold" demo --out demo --json demo.json >"$scratch/said" 2>&1 || fail "the demo ended with $?: $(tail -3 "$scratch/said")"
python3 - "$scratch/here/demo.json" "$prefix" <<'PY' || exit 1
import json
import sys

found, prefix = json.load(open(sys.argv[1])), sys.argv[2]
colour = found["colour"]
wrong = [f"{key}: {colour[key]}" for key in ("weights", "detector") if not str(colour[key]).startswith(prefix)]
if wrong or colour["reason"] or not found["correct"] or not colour["correct"]:
    sys.exit(f"check.sh: the demo used other files than the archive's or found nothing: {wrong} {colour['reason']}")
print(f"demo: {found['correct']} of {found['targets']} poses from depth, {colour['correct']} of {colour['targets']} from colour")
PY
clean "$prefix/bin/sixfold-experiments" --version >/dev/null || fail "sixfold-experiments does not start"
clean bash -c "source '$prefix/share/bash-completion/completions/sixfold' && complete -p sixfold" >/dev/null || fail "bash completions"
pages=("$prefix"/share/man/man1/*.gz)
for command in $(clean "$prefix/bin/sixfold" --help | sed -n '/^Commands:/,/^$/s/^  \([a-z][a-z-]*\) .*/\1/p'); do
    [ "$command" = help ] || [ -s "$prefix/share/man/man1/sixfold-$command.1.gz" ] || fail "no man page of $command"
done
if command -v man >/dev/null; then
    for page in "${pages[@]}"; do
        said=$(LC_ALL=C.UTF-8 man --warnings -E UTF-8 -l -Tutf8 "$page" 2>&1 >/dev/null | grep -i warning || true)
        [ -z "$said" ] || fail "$page: $said"
    done
fi
echo "man pages: ${#pages[@]}"

# A program without its share looks in the user's folder, where the archive of data is unpacked: a file that is spoilt there is named.
mkdir "$scratch/alone/bin"
cp "$prefix/bin/sixfold" "$scratch/alone/bin/sixfold"
mkdir -p "$scratch/home/.local/share"
tar -xzf "$out"/sixfold-data-*.tar.gz -C "$scratch/home/.local/share"
diff -r "$prefix/share/sixfold" "$scratch/home/.local/share/sixfold" || fail "the archives hold different data"
spoilt=$scratch/home/.local/share/sixfold/demo/test_targets_bop19.json
echo spoilt >"$spoilt"
said=$(clean "$scratch/alone/bin/sixfold" demo --out again 2>&1) && fail "a demo on a spoilt file ended well"
[[ $said == *"$spoilt"* ]] || fail "the archive of data was not found in the user's folder: $said"
# Where nothing is, the message says where it looked.
said=$(clean env SIXFOLD_SHARE="$scratch/nowhere" "$scratch/alone/bin/sixfold" demo --out none 2>&1) && fail "a demo without samples ended well"
[[ $said == *"$scratch/nowhere/demo"* ]] || fail "a demo without samples does not say where it looked: $said"
echo "data archive: found in the user's folder; without it: ${said##*error: }"
