#!/bin/sh
# See to a libLLVM that Dr.Jit can use (16 or newer; 14 and 15 abort the process on some machines).
# Installs libllvm19 where this is root on apt; otherwise says in one line how. Never fails: without it, rendering
# falls back to the scalar variant and says so.
for found in /usr/lib/*-linux-gnu/libLLVM*.so* /usr/lib64/libLLVM*.so* /usr/lib/llvm-*/lib/libLLVM*.so* \
             /opt/homebrew/opt/llvm*/lib/libLLVM*.dylib /usr/local/opt/llvm*/lib/libLLVM*.dylib; do
    case "$found" in
        *libLLVM.so.1[6-9]*|*libLLVM.so.2[0-9]*|*libLLVM-1[6-9].so*|*libLLVM-2[0-9].so*|*.dylib)
            [ -e "$found" ] && { echo "libLLVM: using $found"; exit 0; } ;;
    esac
done
if [ -n "${DRJIT_LIBLLVM_PATH:-}" ]; then
    echo "libLLVM: DRJIT_LIBLLVM_PATH is $DRJIT_LIBLLVM_PATH"
elif [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    echo "libLLVM: none that is new enough; installing libllvm19"
    apt-get update -qq >/dev/null 2>&1
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq libllvm19 >/dev/null 2>&1 \
        || DEBIAN_FRONTEND=noninteractive apt-get install -y -qq libllvm18 >/dev/null 2>&1 \
        || echo "libLLVM: apt-get could not install libllvm19; rendering will be slow (scalar) until one is there"
else
    echo "libLLVM: none that is new enough; install one, e.g. 'sudo apt-get install libllvm19' (macOS: 'brew install llvm@19')"
fi
