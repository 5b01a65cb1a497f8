"""Linux's Wi-Fi (mac80211_hwsim) on the radio of fieldkit: the medium that determines which frames arrive."""
