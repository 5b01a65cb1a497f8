# Snapshot of the state of a robot, as its programs report it, before and after an attempt; the state of its clock also
# during the attempt.
#
# All sources run at the same time, each with a time limit, so a program that hangs delays an attempt by SOURCE_S seconds
# at most, and is not started again in the same trial. The sources use local sockets only and send no packet over a
# network: chronyc without names (-n), pmc without boundary hops (-b 0), a passive scan. For each source, a line
# `==> NAME <==` precedes its output. Each line of the output begins with a blank, so that it differs from such a line;
# the last line is `code CODE`.

SOURCE_S=2
KILLED=137 # exit code after SIGKILL
SOURCE_BLOCKS=64 # limit of the output of a source, in blocks of 512 or 1,024 bytes

start_source() { # start the source $1 with the command in the other arguments; it writes the file $1 in $folder
    [ -d "$folder" ] || mkdir "$folder" || return
    name=$folder/$1
    if has_hung "$1"; then
        printf '\ncode %s\n' "$KILLED" >"$name" # as if it had been killed again
        return
    fi
    shift
    {
        # Run in another folder, because the timeout of busybox may run a second longer, and this folder is deleted.
        (ulimit -f "$SOURCE_BLOCKS"; cd / && exec setsid timeout -s KILL "$SOURCE_S" "$@") 2>&1 &
        wait "$!"
        code=$?
        kill -KILL "-$!" # remaining processes of the source, which the timeout of busybox does not stop
        echo
        echo "code $code"
    } </dev/null >"$name" 2>/dev/null &
}

has_hung() { # true if source $1 did not answer in time in an earlier snapshot
    case $hung_sources in *":$1:"*) ;; *) return 1 ;; esac
}

has_timesyncd() { [ -d /run/systemd/system ] && command -v timedatectl >/dev/null; }

start_clock_sources() {
    ! command -v chronyc >/dev/null || start_source chrony chronyc -n -c tracking
    if has_timesyncd; then
        start_source timedatectl timedatectl show
        start_source timesyncd timedatectl timesync-status
    fi
    if command -v pmc >/dev/null; then # its default socket is in a folder that only root can write
        start_source ptp pmc -u -b 0 -i "/tmp/fieldkit-pmc-$$" \
            'GET CURRENT_DATA_SET' 'GET TIME_STATUS_NP' 'GET PORT_DATA_SET'
    fi
}

health() { # print values of the computer, one per line
    read -r line </proc/stat && echo "$line"
    for zone in /sys/class/thermal/thermal_zone*/temp; do
        read -r value 2>/dev/null <"$zone" && echo "temperature $value"
    done
    for supply in /sys/class/power_supply/*; do # the battery of a mouse has the scope Device
        read -r value 2>/dev/null <"$supply/type" && [ "$value" = Battery ] || continue
        read -r value 2>/dev/null <"$supply/scope" && [ "$value" = Device ] && continue
        read -r charge 2>/dev/null <"$supply/capacity" || charge=-
        read -r voltage 2>/dev/null <"$supply/voltage_now" || voltage=-
        echo "battery $charge $voltage"
    done
    for monitor in /sys/class/hwmon/*; do
        read -r value 2>/dev/null <"$monitor/name" && [ "$value" = rpi_volt ] || continue
        read -r value 2>/dev/null <"$monitor/in0_lcrit_alarm" && echo "undervoltage $value"
    done
    (read_free_space && echo "disk $free") || :
}

start_radio_sources() { # start the sources for the radio with interface $1
    command -v iw >/dev/null || return 0
    start_source iw-info iw dev "$1" info
    has_hung iw-info || wait "$!"
    info=$(cat "$folder/iw-info")
    case ${info##*"code "} in
        0) ;;
        "$KILLED") return 0 ;;
        *) rm -f -- "$folder/iw-info" && return 0 ;; # it has no such interface
    esac
    start_source iw-reg iw reg get
    # The counters of the channel are read twice. Between the readings the robots send nothing for an attempt, and the scan
    # is passive, so the difference shows the load by other transmitters.
    start_source iw-survey sh -c 'iw dev "$1" survey dump && { sleep 0.5 || sleep 1; } && echo == && iw dev "$1" survey dump' sh "$1"
    case $info in *"channel "*" ("*" MHz"*) ;; *) return 0 ;; esac
    info=${info#*channel *" ("} # keep only the frequency of `channel 6 (2437 MHz), ...`
    info=${info%%" MHz"*}
    set -- iw dev "$1" scan freq "${info%.*}" passive
    [ "$(id -u)" = 0 ] || set -- sudo -n "$@"
    start_source iw-scan "$@"
}

# Print the outputs of all sources. $1: new folder for temporary files; $2: interface of the radio, or -; $3: file with the
# names of sources that hung before, to which the names of sources that hang now are added, or -; $4: `clock` for the sources
# of the clock only, otherwise empty.
snapshot() {
    folder=$1 hung_sources=:
    [ ! -s "$3" ] || while read -r name; do hung_sources=$hung_sources$name:; done <"$3"
    (
        PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin # often missing in a session without a terminal
        export LC_ALL=C
        start_clock_sources
        [ "${4-}" = clock ] || start_other_sources "$2"
        wait
        [ "$3" = - ] || for source in "$folder"/*; do
            [ "$(tail -n 1 "$source")" != "code $KILLED" ] || has_hung "${source##*/}" || echo "${source##*/}" >>"$3"
        done
        cd "$folder" && awk 'FNR == 1 { print "==> " FILENAME " <==" } { print " " $0 }' *
        rm -rf -- "../${folder##*/}" "/tmp/fieldkit-pmc-$$"
    )
}

start_other_sources() { # start the sources except those of the clock; $1 interface of the radio, or -
    [ "$1" = - ] || start_radio_sources "$1"
    start_source health sh "$self" health
    ! command -v ip >/dev/null || start_source interfaces ip -o link
    ! command -v vcgencmd >/dev/null || start_source vcgencmd vcgencmd get_throttled
}

CLOCK_INTERVAL=10 # s between reports of the clock sources during an attempt

# Start a job that reports on the clock of role $1. Do nothing if no program sets the clock, or if it was started before.
start_clock_sampler() {
    PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
    command -v chronyc >/dev/null || command -v pmc >/dev/null || has_timesyncd || return 0
    mkdir "$PWD/.jobs/clock" 2>/dev/null || return 0
    meta=$PWD/.jobs/clock
    read -r token _ <.began
    echo "report on the clock" >"$meta/command"
    detach "$meta" 86400 - 0 /dev/null "$1-sources-during.txt" "$meta/log" sh "$self" sample_clock "$token" "$CLOCK_INTERVAL"
}

# Print a line `==> next <==` and the outputs of the clock sources at intervals of $2 s until this job is stopped, its folder
# is deleted, or the lock of token $1 (-: none) is lost.
sample_clock() {
    token=$1
    while [ -e .began ]; do
        trap 'kill "$child"; exit 0' TERM INT HUP
        sleep "$2" &
        child=$!
        wait "$child"
        trap '' TERM INT HUP # signals do not interrupt a snapshot, which ends with its programs within SOURCE_S seconds
        [ "$token" = - ] || owns_lock || return 0
        echo "==> next <=="
        snapshot ".clock-$$" - ../.hung-sources clock
    done
}
