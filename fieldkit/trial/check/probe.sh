# Prints the state of a robot in one round trip, and changes nothing. It is run with `sh -s INTERFACE`; calls of
# `section` for the needs of a plan are appended. The section of a missing tool has the code 127.
interface=$1
export LC_ALL=C

section() { # NAME COMMAND...
    name=$1
    shift
    output=$("$@" 2>&1 </dev/null)
    printf '==> %s: %s <==\n%s\n' "$name" "$?" "$output"
}

admin() ( # in a session without a terminal, PATH often lacks the folders of iw and ethtool
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    "$@"
)

system() (
    [ -r /etc/os-release ] && . /etc/os-release && printf '%s, ' "$PRETTY_NAME"
    uname -srm
)

have() { # prints the names of the given programs that exist
    for program in "$@"; do
        admin command -v "$program" >/dev/null && echo "$program"
    done
}

batteries() { # prints the robot's batteries; the battery of a connected device, such as a mouse, has the scope Device
    for supply in /sys/class/power_supply/*; do
        read -r scope 2>/dev/null <"$supply/scope" || scope=System
        [ "$scope" != Device ] && read -r percent 2>/dev/null <"$supply/capacity" && echo "${supply##*/} $percent"
    done
}

section system system
section user id -u
section user-tools have sudo apt-get setcap ss netstat
section control echo "${SSH_CONNECTION-}"
section disk df -Pk .
# States of sockets: 0A is a TCP socket that listens, 07 is a UDP socket.
section listeners grep -h ":0000 0[7A] " /proc/net/tcp /proc/net/tcp6 /proc/net/udp /proc/net/udp6
section interface admin ip addr show dev "$interface"
section offloads admin ethtool -k "$interface"
section wireless ls -d "/sys/class/net/$interface/phy80211"
section wifi-info admin iw dev "$interface" info
section wifi-link admin iw dev "$interface" link
section wifi-stations admin iw dev "$interface" station dump
section wifi-power-save admin iw dev "$interface" get power_save
section batteries batteries
