# State of a robot, read in one round trip. Run by `sh -s INTERFACE`, with further calls of `section` appended for
# the needs of a plan. It only reads. The section of a missing tool has code 127.
interface=$1
export LC_ALL=C

section() { # NAME COMMAND...
    name=$1
    shift
    said=$("$@" 2>&1 </dev/null)
    printf '==> %s: %s <==\n%s\n' "$name" "$?" "$said"
}

admin() ( # a session without a terminal often lacks the folders where iw and ethtool are
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    "$@"
)

system() (
    [ -r /etc/os-release ] && . /etc/os-release && printf '%s, ' "$PRETTY_NAME"
    uname -srm
)

have() { # prints those of the given programs that exist
    for program in "$@"; do
        admin command -v "$program" >/dev/null && echo "$program"
    done
}

batteries() { # of the robot itself; the battery of a mouse has the scope Device
    for supply in /sys/class/power_supply/*; do
        read -r scope 2>/dev/null <"$supply/scope" || scope=System
        [ "$scope" != Device ] && read -r percent 2>/dev/null <"$supply/capacity" && echo "${supply##*/} $percent"
    done
}

section system system
section user id -u
section means have sudo apt-get setcap ss netstat
section control echo "${SSH_CONNECTION-}"
section disk df -Pk .
section listeners grep -h ":0000 0[7A] " /proc/net/tcp /proc/net/tcp6 /proc/net/udp /proc/net/udp6
section interface admin ip addr show dev "$interface"
section offloads admin ethtool -k "$interface"
section wireless ls -d "/sys/class/net/$interface/phy80211"
section wifi-info admin iw dev "$interface" info
section wifi-link admin iw dev "$interface" link
section wifi-stations admin iw dev "$interface" station dump
section wifi-power-save admin iw dev "$interface" get power_save
section batteries batteries
