# One member of the JSON object on standard input, `name`; nothing, and status 1, when it is not there. Booleans are 1 and 0.
{ text = text $0 "\n" }
END {
	if (text !~ /[^ \n]/ || !json(text) || !(("/" name) in value)) exit 1
	print value["/" name]
}
