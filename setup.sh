#!/bin/sh
# Makes a Python environment with everything that constraints.txt pins; make calls it.
#
#   sh setup.sh FOLDER [PYTHON]    FOLDER: such as .venv; PYTHON: of 3.11 to 3.13 (default: the
#                                  first that fits of python3, python3.13, python3.12, python3.11)
#   sh setup.sh --find VERSION     print the machine's Python of a version, such as 3.12, if any
#
# What is there and whole is left alone.  FOLDER/installed is written last and says what the
# environment was made of, so that one that is half made, of other pins or of another Python is
# made anew.  Whatever goes wrong is one line and exit status 2.
set -u

fail() {
  echo "setup: $*" >&2
  exit 2
}

version_of() { "$1" -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])' 2>/dev/null; }

fits() {
  case "$(version_of "$1")" in 3.11.* | 3.12.* | 3.13.*) return 0 ;; *) return 1 ;; esac
}

find_version() { # on the path, else among pyenv's, which keeps those not chosen off the path
  for candidate in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1."*/bin/python; do
    case "$(version_of "$candidate")" in "$1".*) command -v "$candidate"; return 0 ;; esac
  done
  return 1
}

if [ "${1:-}" = --find ]; then
  find_version "${2:?}"
  exit
fi

cd "$(dirname "$0")" || exit 2
venv=${1:?which folder?}
given=${2:-}

pins="$(cat pyproject.toml fastloihi/pyproject.toml constraints.txt setup.sh | cksum)"
if [ -n "$given" ]; then
  fits "$given" || fail "Python 3.11, 3.12 or 3.13 is needed and '$given' is none;" \
    "install one, or name it with PYTHON=/path/to/python3.13"
  wanted=$(version_of "$given")
else
  wanted=$(version_of "$venv/bin/python") # any that is there and fits will do
fi
[ -n "$wanted" ] && [ "$(cat "$venv/installed" 2>/dev/null)" = "$wanted $pins" ] &&
  [ "$(version_of "$venv/bin/python")" = "$wanted" ] && exit 0

python=$given
for candidate in python3 python3.13 python3.12 python3.11; do
  [ -z "$python" ] && fits "$candidate" && python=$candidate
done
[ -n "$python" ] || fail "Python 3.11, 3.12 or 3.13 is needed and none is on the path;" \
  "install one (on Debian and Ubuntu: apt install python3 python3-venv)," \
  "or name it with PYTHON=/path/to/python3.13"

echo "setup: Python $(version_of "$python"), installing into $venv, about two minutes"
"$python" -m venv --clear "$venv" >/dev/null 2>&1 ||
  fail "'$python' cannot make an environment; on Debian and Ubuntu:" \
    "apt install python$(version_of "$python" | cut -d. -f1,2)-venv"

said=$(mktemp) || exit 2
trap 'rm -f "$said"' EXIT
trap 'exit 130' INT
install() { # only what needs no compiler; what pip said of a failure in one line
  "$venv/bin/python" -m pip install -q --disable-pip-version-check -c constraints.txt \
    --only-binary :all: --no-binary nengo-dl "$@" >"$said" 2>&1 ||
    fail "pip could not install:" "$(grep -m 1 -i error "$said" || tail -n 1 "$said");" \
      "mend that and run the same command again"
}
# NengoDL comes as source, and its build asks for a setuptools that fails on Python 3.12 and later:
# it is built with the one that is pinned here.
install setuptools wheel
install --no-build-isolation -e ./fastloihi
install --no-build-isolation -e '.[dev,docs,cluster,live,cameras]'
echo "$(version_of "$venv/bin/python") $pins" >"$venv/installed"
