"""Linux's Wi-Fi (mac80211_hwsim) on the radio of fieldkit: the medium that decides which frames arrive."""
