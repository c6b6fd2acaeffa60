# attack_gate.py PORT SECONDS RATE: opens 1,000 connections to a gate of this computer and says nothing on them, then RATE new ones per second with noise,
# all from 127.0.0.2. Measure beside it with `flyrig-bench receive`.
import socket,sys,time
port=int(sys.argv[1]);secs=float(sys.argv[2]);rate=float(sys.argv[3])
def conn():
    s=socket.socket();s.setblocking(False);s.bind(('127.0.0.2',0))
    try: s.connect(('127.0.0.1',port))
    except BlockingIOError: pass
    return s
held=[]
import resource
resource.setrlimit(resource.RLIMIT_NOFILE,(8192,8192))
for _ in range(1000):
    try: held.append(conn())
    except OSError as e: print(e); break
print('half-open',len(held),flush=True)
start=time.time();n=0;recent=[]
while time.time()-start<secs:
    due=int((time.time()-start)*rate)
    while n<due and time.time()-start<secs:
        n+=1
        try:
            s=conn(); recent.append(s)
            try: s.send(b'\x16\x03\x01\x00\x05hello')
            except OSError: pass
            if len(recent)>500:
                recent.pop(0).close()
        except OSError: pass
    time.sleep(0.001)
print('connections per second',n/secs)
