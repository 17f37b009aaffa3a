#!/bin/bash
# RoboMME on a CPU, into the folder that is named: its source, its environment and a software renderer. See robomme.md.
#
#     bash examples/robomme/install.sh out/robomme
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "${1:?the folder to install into}"
into=$(cd "$1" && pwd)
cd "$into"

source_of() {  # NAME COMMIT: a repository of github.com/RoboMME
  [ -d "$1" ] || git clone --quiet "https://github.com/RoboMME/$1" "$1"
  git -C "$1" checkout --quiet "$2"
}
source_of robomme_benchmark 598e3b4c580990d34681651b1b0ec5a6f4c26524
source_of robomme_policy_learning 3507f80ddc47a6c6363d4af9a51afaa1a3992944

# SAPIEN 3.0.3 needs a newer Mesa than Debian 12 has: it is unpacked here, and the system's stays as it is.
if grep -q '^VERSION_CODENAME=bookworm' /etc/os-release && [ ! -d mesa ]; then
  mkdir -p apt/lists/partial apt/cache/archives/partial
  echo "deb http://deb.debian.org/debian bookworm-backports main" > apt/sources.list
  options="-o Dir::Etc::sourcelist=$into/apt/sources.list -o Dir::Etc::sourceparts=- -o Dir::State::lists=$into/apt/lists
    -o Dir::Cache=$into/apt/cache"
  apt-get $options --quiet update
  (cd apt && apt-get $options --quiet download mesa-vulkan-drivers libdrm2 libdrm-amdgpu1)
  for package in apt/*.deb; do dpkg --extract "$package" mesa; done
  sed -i "s|\"libvulkan_lvp.so\"|\"$into/mesa/usr/lib/x86_64-linux-gnu/libvulkan_lvp.so\"|" mesa/usr/share/vulkan/icd.d/lvp_icd*.json
fi

[ -x venv/bin/python ] || "${PYTHON:-python3.11}" -m venv venv
venv/bin/pip install --quiet "${TORCH:-torch==2.13.0}"
venv/bin/pip install --quiet -r "$here/requirements.txt"

cat > environment <<END
# source this before a simulator is started
for driver in "$into"/mesa/usr/share/vulkan/icd.d/lvp_icd*.json /usr/share/vulkan/icd.d/lvp_icd*.json; do
  [ ! -f "\$driver" ] || break  # the unpacked one first
done
export ROBOMME_LAVAPIPE_ICD=\$driver VK_ICD_FILENAMES=\$driver VK_DRIVER_FILES=\$driver
[ ! -d "$into/mesa" ] || export LD_LIBRARY_PATH="$into/mesa/usr/lib/x86_64-linux-gnu"
export LP_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1  # more threads only wait for each other at 256 px
export PYTHONPATH="$here:$into/robomme_benchmark/src:$into/robomme_benchmark:$into/robomme_policy_learning/packages/openpi-client/src"
export ROBOMME="$into"
END
echo "installed; now:  source $1/environment"
