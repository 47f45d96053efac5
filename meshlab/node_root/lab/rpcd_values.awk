# The options that a call of `uci set` names, as `uci set` takes them: CONFIG.SECTION.OPTION=VALUE.
{ text = text $0 "\n" }
END {
	if (!json(text)) exit 1
	count = split(substr(members["/values"], 2), option, "\t")
	for (n = 1; n <= count; n++) print value["/config"] "." value["/section"] "." option[n] "=" value["/values/" option[n]]
}
