#!/usr/bin/env bash
# Installs the browser that the test of the page needs; the test is skipped where there is none.
set -euo pipefail
if command -v chromium >/dev/null && command -v chromedriver >/dev/null; then
  exit 0
fi
if [[ "$(id -u)" != 0 ]] || ! command -v apt-get >/dev/null; then
  echo "No chromium and chromedriver; as root on Debian: apt-get install chromium chromium-driver" >&2
  exit 0
fi
apt-get update -qq
DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends \
  chromium chromium-driver libegl1
