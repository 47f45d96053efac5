"""The commands of `meshctl lab`."""
