# The folder of an attempt: `begin` creates it, and `pack` sends its files. Both write the state of the host to it.

PIECE=4194304 # as PIECE_BYTES of fetching.py

print_state() { # print the state of the host, of interface $1 and of the radio with interface $radio
    interface=$1
    set --
    for file in /proc/net/snmp /proc/net/netstat /proc/net/dev /proc/net/wireless /proc/loadavg \
        /proc/sys/net/ipv4/tcp_congestion_control; do
        [ -r "$file" ] && set -- "$@" "$file"
    done
    print_clock
    awk 'FNR == 1 { print "==> " FILENAME " <==" } { print }' "$@"
    echo "==> ip -s link <==" && { ip -s link show dev "$interface" || ip link show dev "$interface"; }
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin # often missing in a session without a terminal
    if command -v ethtool >/dev/null; then
        echo "==> ethtool -k <==" && ethtool -k "$interface"
    fi
    if command -v iw >/dev/null; then
        echo "==> iw info <==" && timeout -s KILL "$SOURCE_S" iw dev "$radio" info
        if [ "$?" != "$KILLED" ]; then # a driver that does not answer would delay the attempt
            echo "==> iw station dump <==" && iw dev "$radio" station dump
            echo "==> iw power save <==" && iw dev "$radio" get power_save
        fi
    fi
    echo "==> end <==" # missing if the disk is full
}

print_clock() { # print the boot ID, then three times the clock between two readings of the seconds since boot
    read -r boot </proc/sys/kernel/random/boot_id
    echo "==> boot <=="
    echo "$boot"
    echo "==> clock <=="
    for _ in 1 2 3; do
        read -r before _ </proc/uptime
        read_clock || time=$(date -u +%s)
        read -r after _ </proc/uptime
        echo "$before $time $after"
    done
    echo "==> date <=="
    echo "$time"
}

# Set time to the clock with the fraction of a second. busybox provides the fraction only through adjtimex; if its status
# has the bit STA_NANO (8192), tv_usec is in nanoseconds.
read_clock() {
    time=$(date -u +%s.%N)
    case $time in '' | *[!0-9.]* | *.) ;; *) return ;; esac
    time=$(adjtimex 2>/dev/null | awk '
        /status:/ { nano = int($2 / 8192) % 2 } /tv_sec:/ { s = $NF } /tv_usec:/ { u = $NF }
        END { if (s == "" || u == "") exit 1; printf "%d.%09d\n", s, nano ? u : u * 1000 }')
}

# Print the end of each job: NAME HOW CODE STARTED ENDED. HOW is `itself`, `asked` (fieldkit stopped it), `limit` (its time
# limit) or `running`; STARTED is in clock ticks and ENDED in seconds since boot.
print_job_ends() {
    for meta in .jobs/*; do
        [ -s "$meta/pid" ] || continue
        how=itself code=- ended=-
        read -r _ started _ <"$meta/pid"
        [ ! -s "$meta/exit" ] || read -r code <"$meta/exit"
        [ ! -s "$meta/ended" ] || read -r ended <"$meta/ended"
        if [ -e "$meta/asked" ]; then how=asked; elif [ -e "$meta/limit" ]; then how=limit; fi
        [ "$code" != - ] || ! alive "$meta" || how=running
        echo "${meta##*/} $how $code $started $ended"
    done
}

read_free_space() { # set free to the free disk space in KiB
    table=$(df -Pk "$base")
    # The words of the last line: device, size, used, free.
    set -- ${table##*
}
    free=${4-}
    case $free in '' | *[!0-9]*) fail "df prints no free space of $base" ;; esac
}

fail_to_write() { # fail with the reason why file $1 cannot be written
    read_free_space
    rm -f -- "$1"
    # On a full disk, df may still report a few KiB.
    [ "$free" -gt 64 ] || fail "cannot write $1: No space left on device" "$DISK"
    reason=$({ printf '' >"$1"; } 2>&1) && rm -f -- "$1"
    fail "cannot write $1${reason:+: ${reason##*: }}"
}

write_snapshot() { # write file $1 with a snapshot of the sources of this robot with radio $2, unless it exists
    [ -e "$1" ] || snapshot ".sources-$$" "$2" ../.hung-sources >"$1" 2>/dev/null || fail_to_write "$1"
}

begin() {
    dir=$1 role=$2 interface=$3 kib=$4 token=$5 old=${6-}
    [ -z "$old" ] || remove "$old" # before the lock is checked, because fetched files must be deleted also without a lock
    [ "$token" = - ] || renew "$token" 0
    read_free_space
    [ "$free" -ge "$kib" ] || fail "$free KiB of disk are free, $kib KiB are needed" "$DISK"
    mkdir -p "$dir/.jobs" && cd "$dir" || fail_to_write "$dir"
    if [ ! -s .began ]; then
        read -r boot </proc/sys/kernel/random/boot_id && echo "$token $boot" >.began || fail_to_write .began
        sync_to_disk .began . "$base" </dev/null >/dev/null 2>&1 &
    fi
    find_radio "$interface"
    [ -e "$role-before.txt" ] || print_state "$interface" >"$role-before.txt" 2>&1 || fail_to_write "$role-before.txt"
    write_snapshot "$role-sources-before.txt" "$radio"
    start_sampler "$role" "$radio"
    start_clock_sampler "$role"
    [ $# -le 6 ] || { shift 6 && poll_sources "$role" "$interface" "$@"; }
    read -r boot </proc/sys/kernel/random/boot_id && echo "$boot"
}

pack() {
    dir=$1 role=$2
    enter "$dir"
    stop_samplers "$role"
    await_leaving_jobs
    find_radio "$3"
    [ -e "$role-after.txt" ] || { echo "==> jobs <==" && print_job_ends && print_state "$3"; } >"$role-after.txt" 2>&1 ||
        fail_to_write "$role-after.txt"
    write_snapshot "$role-sources-after.txt" "$radio"
    set --
    for file in * */*; do
        [ -f "$file" ] && [ ! -L "$file" ] && set -- "$@" "$file"
    done
    # The names are unique, so that a repeated `pack` does not overwrite files that the first `pack` still sends.
    wc -c -- "$@" >".sizes-$$" || fail_to_write ".sizes-$$"
    printf '' >".large-$$" || fail_to_write ".large-$$"
    exec 6<".sizes-$$"
    # Each iteration removes the first argument, and appends it again if the file is small.
    unsorted=$# small=0
    while [ "$unsorted" -gt 0 ]; do
        file=$1 unsorted=$((unsorted - 1))
        shift
        read -r size _ <&6
        if [ $((small + size)) -le "$PIECE" ]; then
            small=$((small + size))
            set -- "$@" "$file"
        else
            printf '%s %s\n' "$size" "$file" >>".large-$$" || fail_to_write ".large-$$"
        fi
    done
    sha256sum -- "$@" >".sums-$$" || fail_to_write ".sums-$$"
    tar -cf - -- ".sums-$$" ".large-$$" "$@" || exit
    [ -z "$late_error" ] || fail "$late_error"
}

piece() {
    enter "$1"
    exec dd if="$2" bs="$4" skip="$3" count=1 2>/dev/null
}

sum() {
    enter "$1"
    exec sha256sum -- "$2"
}

tidy() { # delete the folders in $1 except those with the names in the other arguments
    trial=$1
    shift
    for dir in "$trial"/*; do
        for kept_name do [ "${dir##*/}" != "$kept_name" ] || continue 2; done
        remove "$dir"
    done
    rm -f -- "$trial/.hung-sources"
}
