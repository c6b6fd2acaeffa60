# attack_page.py PORT SECONDS RATE: asks the page's server of this computer (plain HTTP) RATE times per second over 64 connections that stay open,
# without a token, and counts the answers. Measure beside it with `flyrig-bench receive`.
import selectors,socket,sys,time
port=int(sys.argv[1]);secs=float(sys.argv[2]);rate=float(sys.argv[3])
ask=('GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\n\r\n'%port).encode()
selector=selectors.DefaultSelector();connections={}
def connect():
    s=socket.socket();s.connect(('127.0.0.1',port));s.setblocking(False)
    selector.register(s,selectors.EVENT_READ);connections[s]=b''
def leave(s):
    selector.unregister(s);del connections[s];s.close()
start=time.time();asked=answered=closed=0
while time.time()-start<secs:
    while len(connections)<64: connect()
    due=int((time.time()-start)*rate)
    for s in list(connections):
        count=min(due-asked,20)
        if count<=0: break
        try: asked+=s.send(ask*count)//len(ask)
        except BlockingIOError: pass
        except OSError: leave(s);closed+=1
    for key,_ in selector.select(0.002):
        try: data=key.fileobj.recv(1<<16)
        except OSError: data=b''
        if data: answered+=data.count(b'HTTP/1.1 ')
        else: leave(key.fileobj);closed+=1
took=time.time()-start
print('asked %.0f answered %.0f per second, %d connections closed'%(asked/took,answered/took,closed))
