#!/bin/sh
# Installs edge-agent as a systemd service on this machine, or takes it away again. May run twice: the second time it
# updates. Configuration and recordings stay, whatever happens, unless --purge is given.
#
#   sudo systemd/install.sh                      from this checkout; fetches the libraries
#   sudo systemd/install.sh --wheels FOLDER      from a folder of wheels, without a network
#   sudo systemd/install.sh --uninstall [--purge]    also as /opt/edge-agent/share/install.sh
#
# The folder of wheels is made on a machine with a network, same architecture and Python: pip wheel -w FOLDER .
# DESTDIR=/some/root lays the files below that folder and touches nothing else (for packagers and tests).
set -eu

HERE=$(cd "$(dirname "$0")" && pwd)
ROOT=${DESTDIR:-}
PYTHON=${PYTHON:-python3}
OPT=/opt/edge-agent
VENV=$OPT/venv
ETC=/etc/edge-agent
DATA=/var/lib/edge-agent
UNIT=/etc/systemd/system/edge-agent.service
NETWORK=/etc/systemd/network/80-can0.network
RULES=/etc/udev/rules.d/80-edge-agent.rules
MODULES=/etc/modules-load.d/edge-agent.conf
SYSCTL=/etc/sysctl.d/80-edge-agent.conf
COMMAND=/usr/local/bin/edge-agent
NAME=edge-agent
QUIET='--quiet --disable-pip-version-check --no-input'

say() { printf '%s\n' "$*"; }
fail() { printf 'install.sh: %s\n' "$*" >&2; exit 1; }
usage() { sed -n '2,/^set -eu/{/^set -eu/d;s/^# \{0,1\}//;p;}' "$0"; }
live() { [ -z "$ROOT" ]; }                           # on this machine, not below DESTDIR
running() { live && [ -d /run/systemd/system ]; }    # and systemd runs it

WHEELS='' UNINSTALL='' PURGE=''
while [ $# -gt 0 ]; do
    case $1 in
        --wheels)
            [ $# -ge 2 ] || fail "--wheels needs a folder"
            WHEELS=$2
            shift
            ;;
        --uninstall) UNINSTALL=1 ;;
        --purge) PURGE=1 ;;
        -h | --help) usage; exit 0 ;;
        *) fail "unknown option $1; --help shows what there is" ;;
    esac
    shift
done
[ -z "$PURGE" ] || [ -n "$UNINSTALL" ] || fail "--purge goes with --uninstall"
if live; then
    [ "$(id -u)" -eq 0 ] || fail "must run as root: sudo $0"
fi

# Copies FILE to TARGET with mode 0644; says so when that changes something.
put() {
    if ! cmp -s "$HERE/$1" "$ROOT$2"; then
        mkdir -p "$ROOT$(dirname "$2")"
        cp "$HERE/$1" "$ROOT$2.new"
        chmod 0644 "$ROOT$2.new"
        mv -f "$ROOT$2.new" "$ROOT$2"
        say "  $2"
    fi
}

# As `put`, but what is there belongs to the technician and stays.
put_once() {
    if [ -e "$ROOT$2" ]; then
        cmp -s "$HERE/$1" "$ROOT$2" || say "  $2 stays as it is"
    else
        put "$1" "$2"
    fi
}

check_python() {
    command -v "$PYTHON" >/dev/null || fail "no $PYTHON here: apt-get install python3 python3-venv"
    "$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
        || fail "$("$PYTHON" -V 2>&1) is too old: 3.11 or newer is needed; PYTHON=/path/to/python3 chooses another"
    "$PYTHON" -c 'import ensurepip, venv' 2>/dev/null || fail "$PYTHON has no venv: apt-get install python3-venv"
}

make_user() {
    getent group dialout >/dev/null || groupadd --system dialout
    if ! getent passwd $NAME >/dev/null; then
        useradd --system --user-group --home-dir $DATA --no-create-home --shell /usr/sbin/nologin $NAME
        say "  user $NAME"
    fi
    # The unit would see to both; `check --live` runs as this user before the first start.
    usermod -aG dialout $NAME
    if [ ! -d $DATA ]; then
        mkdir -p $DATA
        chmod 0755 $DATA
        chown $NAME:$NAME $DATA
    fi
}

make_venv() {
    # Made anew where it is absent, half done, or of a Python that an update of the system has replaced.
    "$VENV/bin/python" -m pip --version >/dev/null 2>&1 || "$PYTHON" -m venv --clear $VENV
    if [ -z "$WHEELS" ]; then # a copy, so that nothing of root's stays in the checkout
        work=$(mktemp -d)
        trap 'rm -rf "$work"' EXIT
        for part in pyproject.toml README.md LICENSE edge_agent drivers; do
            cp -R "$HERE/../$part" "$work/"
        done
    fi
    # Twice: the first brings the agent even where its version number has not changed, the second what it needs.
    for more in "--force-reinstall --no-deps" ""; do
        # shellcheck disable=SC2086 # two words
        if [ -n "$WHEELS" ]; then
            $VENV/bin/pip $QUIET install $more --no-index --find-links "$WHEELS" $NAME
        else
            $VENV/bin/pip $QUIET install $more "$work"
        fi || fail "the libraries could not be installed: see above. Nothing but $VENV was changed"
    done
    $VENV/bin/edge-agent --version >/dev/null || fail "the agent does not start: $VENV/bin/edge-agent --version"
    mkdir -p "$(dirname $COMMAND)"
    ln -sfn $VENV/bin/edge-agent $COMMAND
}

reload() {
    running || return 0
    systemctl daemon-reload
    if command -v udevadm >/dev/null; then
        udevadm control --reload || true
        udevadm trigger --action=change --subsystem-match=tty || true
    fi
    if systemctl is-active --quiet systemd-networkd; then
        networkctl reload || true
    fi
}

install() {
    if [ -n "$WHEELS" ]; then
        [ -d "$WHEELS" ] || fail "$WHEELS is no folder"
        WHEELS=$(cd "$WHEELS" && pwd)
        ls "$WHEELS"/edge_agent-*.whl >/dev/null 2>&1 || fail "$WHEELS holds no wheel of edge-agent: pip wheel -w FOLDER ."
    elif live && [ ! -f "$HERE/../pyproject.toml" ]; then
        fail "this is no checkout; name a folder of wheels with --wheels"
    fi
    if live; then
        check_python
        say "installing:"
        make_user
        say "  $VENV (takes some minutes on a small board)"
        make_venv
    else
        say "files below $ROOT:"
    fi
    for file in install.sh edge-agent.service network.conf data-dir.conf 80-can0.network 80-edge-agent.rules \
        edge-agent.modules edge-agent.sysctl example.yaml example.dbc; do
        put $file $OPT/share/$file
    done
    chmod 0755 "$ROOT$OPT/share/install.sh"
    put example.yaml $ETC/example.yaml
    put_once example.dbc $ETC/example.dbc
    first=''
    [ -e "$ROOT$ETC/site.yaml" ] || first=1
    put_once example.yaml $ETC/site.yaml
    put_once 80-can0.network $NETWORK
    put edge-agent.service $UNIT
    put 80-edge-agent.rules $RULES
    put edge-agent.modules $MODULES
    put edge-agent.sysctl $SYSCTL
    live || return 0
    while read -r module; do
        case $module in '#'* | '') ;; *) modprobe -q "$module" || say "  this kernel has no module $module" ;; esac
    done <"$HERE/edge-agent.modules"
    sysctl -q -p $SYSCTL || true
    reload
    if running && systemctl is-active --quiet $NAME; then
        say "restarting the service"
        systemctl restart $NAME || fail "it does not come up again: journalctl -u $NAME"
    fi
    say "installed: $($VENV/bin/edge-agent --version)"
    if [ -n "$first" ]; then
        say "next:"
        say "  1. write $ETC/site.yaml (a copy of the example, which explains every key)"
        say "  2. set the sensors' bit rate in $NETWORK, then systemctl enable --now systemd-networkd"
        say "  3. edge-agent check -c $ETC/site.yaml; sudo -u $NAME edge-agent check --live -c $ETC/site.yaml"
        say "  4. systemctl enable --now $NAME && edge-agent status --watch"
    elif ! $VENV/bin/edge-agent check -c $ETC/site.yaml; then
        fail "$ETC/site.yaml does not fit this version: see above"
    fi
}

uninstall() {
    if running && [ -e $UNIT ]; then
        systemctl disable --now --quiet $NAME || true
    fi
    if [ -z "$PURGE" ] && [ -e "$ROOT$NETWORK" ] && ! cmp -s "$ROOT$OPT/share/80-can0.network" "$ROOT$NETWORK"; then
        say "kept: $NETWORK (changed by hand)"
    else
        rm -f "$ROOT$NETWORK"
    fi
    rm -f "$ROOT$UNIT" "$ROOT$RULES" "$ROOT$MODULES" "$ROOT$SYSCTL"
    rm -f "$ROOT$ETC/example.yaml"
    if [ -L "$ROOT$COMMAND" ] && [ "$(readlink "$ROOT$COMMAND")" = $VENV/bin/edge-agent ]; then
        rm -f "$ROOT$COMMAND"
    fi
    rm -rf "$ROOT$OPT" "$ROOT/run/$NAME"
    if [ -n "$PURGE" ]; then
        rm -rf "$ROOT$ETC" "$ROOT$DATA" "$ROOT$UNIT.d"
        if live && getent passwd $NAME >/dev/null; then
            userdel $NAME
        fi
    fi
    reload
    if running; then
        systemctl reset-failed --quiet $NAME 2>/dev/null || true
    fi
    if [ -n "$PURGE" ]; then
        say "removed, with configuration and recordings"
    else
        say "removed; kept: $ETC, $DATA and the user $NAME that owns it (--purge removes these too)"
    fi
}

if [ -n "$UNINSTALL" ]; then
    uninstall
else
    install
fi
