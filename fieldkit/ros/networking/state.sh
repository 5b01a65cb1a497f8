# Prints the state of a robot that determines whether its ROS programs reach other robots. Run by `sh -s`, after its
# ROS setup files were sourced. It changes nothing. Each section has a name, an exit code and an output, as in probe.sh.
export LC_ALL=C

section() { # NAME COMMAND...
    name=$1
    shift
    output=$("$@" 2>&1 </dev/null)
    printf '==> %s: %s <==\n%s\n' "$name" "$?" "$output"
}

admin() ( # COMMAND...: run as root; PATH of a session without a terminal often lacks the sbin folders
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    [ "$(id -u)" = 0 ] || set -- sudo -n "$@"
    timeout 5 "$@"
)

ros_variables() { # filters an environment on standard input, one variable per line
    grep -E '^(ROS_(DISTRO|VERSION|DOMAIN_ID|LOCALHOST_ONLY|AUTOMATIC_DISCOVERY_RANGE|STATIC_PEERS|DISCOVERY_SERVER|MASTER_URI|HOSTNAME|IP)|RMW_IMPLEMENTATION|CYCLONEDDS_URI|FASTRTPS_DEFAULT_PROFILES_FILE|FASTDDS_DEFAULT_PROFILES_FILE|ZENOH_ROUTER_CONFIG_URI|ZENOH_SESSION_CONFIG_URI)=' | cut -c1-2000
}

own_environment() {
    env | ros_variables
    return 0
}

ros_programs() { # the variables of each running program that has a ROS distribution in its environment
    for folder in /proc/[0-9]*; do
        # Skip a program that exits during this command, or whose environment belongs to another user.
        variables=$(tr '\0' '\n' <"$folder/environ" | ros_variables) 2>/dev/null || continue
        case $variables in
        *ROS_DISTRO=*) printf 'program %s\n%s\n' "$(tr -d '\n' <"$folder/comm")" "$variables" ;;
        esac
    done 2>/dev/null | head -c 100000
}

settings_of() { # VALUE of a variable: the URI or path of a file with settings of the RMW, or the settings themselves
    case $1 in
    file://*) head -c 20000 "${1#file://}" ;;
    /*) head -c 20000 "$1" ;;
    *) printf '%s\n' "$1" ;;
    esac
}

kernel() {
    for key in net/core/rmem_max net/core/rmem_default net/ipv4/ipfrag_time net/ipv4/ipfrag_high_thresh; do
        read -r value <"/proc/sys/$key" && echo "$key $value"
    done
}

section environment own_environment
section programs ros_programs
section kernel kernel
section route ip -o route get 239.255.0.1
# Sockets that listen (TCP, state 0A) or are bound (UDP, state 07) and have no peer (port 0000).
section listeners grep -h ":0000 0[7A] " /proc/net/tcp /proc/net/tcp6 /proc/net/udp /proc/net/udp6
section hostname hostname
section cyclonedds settings_of "${CYCLONEDDS_URI-}"
section fastdds settings_of "${FASTDDS_DEFAULT_PROFILES_FILE-${FASTRTPS_DEFAULT_PROFILES_FILE-}}"
section nftables admin nft list ruleset
section iptables admin iptables -S
